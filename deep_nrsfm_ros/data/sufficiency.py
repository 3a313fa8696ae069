"""Whether a dataset varies enough for NRSfM, from the 2D keypoints alone.

Depth shows only where the object turns against the camera, and a shape basis only where it
deforms. Both leave traces in the spectrum of the stacked W (2 f x p): rank two is a flat object
or one unchanging view, rank three a rigid object in 3D, and what lies beyond is deformation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.batched import slices
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.nrsfm.geometry import on_one_line, polar

Floats = NDArray[np.float64]

FEWEST_FRAMES = 10
_FEW_FRAMES = 300  # below it a network learns its frames by heart
_FLAT = 0.01  # third direction, as a share of the extent, below any detector's noise
_ABOVE_NOISE = 1.5  # by which the third direction must exceed the median of those after it
_CHAOS = 0.1  # noise, as a share of the extent, that leaves no shape to see
_NARROW = 20.0  # degrees of view span below which depth is hardly seen
_STIFF = 0.02  # share of the extent beyond a rigid object that may be noise
_RARELY = 0.01  # share of the frames below which a keypoint does not count
_SAMPLE = 4000  # frames whose spectrum is looked at
_ROUNDS = 10  # of filling missing points, for each rank


@dataclass(frozen=True)
class Sufficiency:
    """What the data shows.

    frames: how many. points: keypoints that are seen often enough to count.
    spectrum: (points,) singular values of the stacked, normalised W, their squares adding to 1.
    view_span: degrees from the mean viewing direction within which 90 % of the views lie, if the
        object were rigid. Deformation that looks like a turn counts as one.
    deformation: share of the extent, 0..1, that no rigid object explains.
    refusal: why no model can come of it and what would help, "" if one may.
    warnings: sentences on what makes it doubtful.
    """

    frames: int
    points: int
    spectrum: tuple[float, ...]
    view_span: float
    deformation: float
    refusal: str
    warnings: tuple[str, ...]

    @property
    def summary(self) -> str:
        """Return the figures in one sentence."""
        return (
            f"views span {self.view_span:.0f} degrees; "
            f"{100 * self.deformation:.0f} % of the extent is beyond a rigid object"
        )


def assess_sufficiency(dataset: Dataset) -> Sufficiency:
    """Tell whether a model can be learned from the dataset; deterministic, within a second."""
    seen = dataset.visible.sum(0)
    counts = seen >= max(1, _RARELY * len(dataset))
    frames, points = len(dataset), int(counts.sum())
    if points < 4:
        names = [n for n, often in zip(dataset.layout.keypoints, counts, strict=True) if often]
        return _refused(
            frames,
            points,
            f"only {points} keypoints are seen ({', '.join(names) or 'none'}); NRSfM needs at "
            "least 4, better 8; check the layout and lower --min-confidence",
        )
    lines = np.zeros(len(dataset), bool)
    for part in slices(len(dataset)):
        seen_there = dataset.visible[part][:, counts]
        lines[part] = on_one_line(dataset.points[part][:, counts], seen_there)
    usable = (dataset.visible[:, counts].sum(1) >= 3) & ~lines
    frames = int(usable.sum())
    if frames < FEWEST_FRAMES <= lines.sum():
        return _refused(
            frames,
            points,
            f"in {lines.sum()} of {len(dataset)} frames all keypoints lie on one line; add "
            "keypoints off that line, or look at the detector",
        )
    if frames < FEWEST_FRAMES:
        return _refused(
            frames,
            points,
            f"{frames} of {len(dataset)} frames are usable (3 keypoints, not on one line); at "
            f"least {FEWEST_FRAMES} that differ are needed, better thousands: record for longer, "
            "and move the object or the camera meanwhile",
        )
    chosen = np.flatnonzero(usable)[:: -(-frames // _SAMPLE)]
    W, visible = dataset.points[chosen][:, counts], dataset.visible[chosen][:, counts]
    stacked = _filled(_stacked(W, visible), np.repeat(visible, 2, axis=0))
    U, values, _ = np.linalg.svd(stacked, full_matrices=False)
    values /= np.linalg.norm(values) or 1.0
    span = view_span(U[:, :3].reshape(-1, 2, 3))
    deformation = float(np.sqrt(max(0.0, 1 - (values[:3] ** 2).sum())))
    found = (frames, points, tuple(values.tolist()), span, deformation)
    refusal = _flatness(values)
    return Sufficiency(*found, refusal, () if refusal else _doubts(frames, span, deformation))


def view_span(motion: Floats) -> float:
    """Return the degrees around the mean viewing direction that hold 90 % of the views.

    motion: (f, 2, 3), two rows a frame of the left factor of W. The metric upgrade of Tomasi and
    Kanade (IJCV 1992), x Q x = y Q y = 1 and x Q y = 0, makes them rows of rotations.
    """
    x, y = motion[:, 0], motion[:, 1]
    i, j = np.triu_indices(3)
    weight = np.where(i == j, 0.5, 1.0)

    def products(a: Floats, b: Floats) -> Floats:
        terms: Floats = weight * (a[:, i] * b[:, j] + a[:, j] * b[:, i])
        return terms

    # Sizes are equal on the whole, not frame by frame: a side view may be smaller or larger.
    system = np.concatenate([products(x, x), products(y, y), products(x, y)])
    ones = np.repeat([1.0, 1.0, 0.0], len(motion))
    Q = np.zeros((3, 3))
    Q[i, j] = Q[j, i] = np.linalg.lstsq(system, ones, rcond=None)[0]
    sizes, axes = np.linalg.eigh(Q)
    R = polar(motion @ (axes * np.sqrt(np.maximum(sizes, 0))))
    views = np.cross(R[:, 0], R[:, 1])
    mean = views.mean(0)
    mean /= max(float(np.linalg.norm(mean)), 1e-12)
    angles = np.degrees(np.arccos(np.clip(views @ mean, -1, 1)))
    return float(np.percentile(angles, 90))


def _refused(frames: int, points: int, refusal: str) -> Sufficiency:
    """Return a refusal for data too small to have a spectrum."""
    return Sufficiency(frames, points, (), 0.0, 0.0, refusal, ())


def _flatness(values: Floats) -> str:
    """Return why the spectrum rules depth out, "" if it does not."""
    tail = values[len(values) // 2 : -1]  # the last is 0, as the rows are centred
    noise = float(np.median(tail)) if len(values) >= 8 else 0.0
    if values[2] < max(_FLAT, _ABOVE_NOISE * noise):
        if noise > _CHAOS:
            return (
                "the frames have no shape in common: their keypoints scatter in every direction "
                "alike; look at the keypoint layout, and whether several kinds of objects are mixed"
            )
        return (
            f"the views are flat: the third direction of the stacked keypoints holds "
            f"{100 * values[2]:.1f} % of the extent, no more than noise, so that depth cannot be "
            "seen; turn the object or move the camera around it (a flat object cannot be lifted)"
        )
    return ""


def _doubts(frames: int, span: float, deformation: float) -> tuple[str, ...]:
    """Return a sentence for each figure that makes a training doubtful."""
    found = []
    if frames < _FEW_FRAMES:
        found.append(
            f"{frames} frames are few; expect a model of those frames alone, and record "
            "thousands for one that knows others"
        )
    if span < _NARROW:
        found.append(
            f"the views span only {span:.0f} degrees around their mean, so that depth rests on "
            "deformation alone and may come out mirrored; record the object from more sides, "
            "start from a model that knows it (--from, train.from), or let the layout help "
            "(bone_length_weight, handedness_weight)"
        )
    if deformation < _STIFF:
        found.append(
            f"the object hardly deforms ({100 * deformation:.1f} % of the extent): expect one "
            "rigid shape; record it in other poses for more"
        )
    return tuple(found)


def _stacked(points: NDArray[np.float32], visible: NDArray[np.bool_]) -> Floats:
    """Return W (2 f, p), rows x_1, y_1, x_2, ...; frames centred, of RMS radius 1."""
    mask = visible[..., None].astype(np.float64)
    number = mask.sum(1, keepdims=True)
    X = (points - (points * mask).sum(1, keepdims=True) / number) * mask
    radius = np.sqrt((X * X).sum((1, 2), keepdims=True) / number)
    rows: Floats = (X / np.maximum(radius, 1e-9)).swapaxes(1, 2).reshape(-1, points.shape[1])
    return rows


def _filled(W: Floats, known: NDArray[np.bool_]) -> Floats:
    """Return W (2 f, p) with missing entries from its leading directions, rows centred.

    The rank grows to three: from the start it would keep the zeros of missing points as a
    direction of its own.
    """
    filled = W
    if not known.all():
        for rank in (1, 2, 3):
            for _ in range(_ROUNDS):
                axes = np.linalg.eigh(filled.T @ filled)[1][:, -rank:]
                filled = np.where(known, W, filled @ axes @ axes.T)
    centred: Floats = filled - filled.mean(1, keepdims=True)
    return centred
