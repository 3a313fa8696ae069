# SPDX-License-Identifier: Apache-2.0
"""Sufficiency: whether a dataset varies enough for NRSfM, from its 2D keypoints.

Depth is observable only if the object rotates relative to the camera, and a shape basis only if the
object deforms. Both show in the spectrum of the stacked W (2 f x p): rank two is a flat object or
a single view, rank three a rigid object in 3D, and the rest is deformation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.batched import slices
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.hands import mixed_sides
from deep_nrsfm_ros.nrsfm.geometry import centre_visible, on_one_line, polar, rms_radius
from deep_nrsfm_ros.wording import wording

Floats = NDArray[np.float64]

MIN_FRAMES = 10
"""Least number of usable frames."""
_FEW_FRAMES = 300  # with fewer a network memorises its frames
_MIN_THIRD = 0.01  # singular value of the third direction; less is below any detector's noise
_ABOVE_NOISE = 1.5  # least ratio of the third direction to the median of those after it
_MAX_NOISE = 0.1  # singular value of the noise above which there is no common shape
_NARROW = 20.0  # view span in degrees below which depth is hardly observable
_RIGID = 0.02  # deformation that may be noise
_MIN_VISIBLE_SHARE = 0.01  # of the frames, for a keypoint to count
_SAMPLE = 4000  # frames whose spectrum is computed
_ROUNDS = 10  # rounds of filling in missing points, for each rank


@dataclass(frozen=True)
class Sufficiency:
    """The variation of a dataset, and whether it suffices for a training.

    Attributes:
        frames: number of usable frames.
        keypoints: number of keypoints that are visible in at least 1 % of the frames.
        spectrum: (keypoints,) singular values of the stacked, normalised W; their squares sum to 1.
        view_span: angle in degrees around the mean viewing direction that contains 90 % of the
            views, for a rigid object; below 20 is narrow. Deformation that looks like a rotation
            counts as one.
        deformation: RMS share, 0 to 1, of the extent that no rigid object explains; below 0.02 the
            object is rigid.
        refusal: why no model can be learned and what would help; "" if one can.
        warnings: sentences on what may make the model poor.
    """

    frames: int
    keypoints: int
    spectrum: tuple[float, ...]
    view_span: float
    deformation: float
    refusal: str
    warnings: tuple[str, ...]

    @property
    def summary(self) -> str:
        """Return view span and deformation in one sentence."""
        return (
            f"views span {self.view_span:.0f} degrees; "
            f"{100 * self.deformation:.0f} % of the extent is beyond a rigid object"
        )


def assess_sufficiency(
    dataset: Dataset, *, has_start: bool = False, near_duplicates: int = 0
) -> Sufficiency:
    """Return whether a model can be learned from a dataset; deterministic, within a second.

    Args:
        dataset: the frames.
        has_start: whether the training starts from a model, which has learned depth elsewhere.
        near_duplicates: number of frames that the curation left out as such.
    """
    counts = dataset.visible.sum(0) >= max(1, _MIN_VISIBLE_SHARE * len(dataset))
    frames, keypoints = len(dataset), int(counts.sum())
    if keypoints < 4:
        names = [
            n for n, frequent in zip(dataset.layout.keypoints, counts, strict=True) if frequent
        ]
        return _refused(
            frames,
            keypoints,
            f"only {keypoints} keypoints are visible ({', '.join(names) or 'none'}); NRSfM needs "
            "at least 4, better 8; check the layout and "
            + wording(
                "lower --min-confidence", node="lower min_confidence", python="the confidence"
            ),
        )
    lines = np.zeros(len(dataset), bool)
    for part in slices(len(dataset)):
        visible = dataset.visible[part][:, counts]
        lines[part] = on_one_line(dataset.points[part][:, counts], visible)
    usable = (dataset.visible[:, counts].sum(1) >= 3) & ~lines
    frames = int(usable.sum())
    if frames < MIN_FRAMES <= lines.sum():
        return _refused(
            frames,
            keypoints,
            f"in {lines.sum()} of {len(dataset)} frames all keypoints lie on one line; add "
            "keypoints off that line, or look at the detector",
        )
    if frames < MIN_FRAMES:
        return _refused(
            frames,
            keypoints,
            f"{frames} of {len(dataset)} frames are usable (3 keypoints, not on one line); at "
            f"least {MIN_FRAMES} that differ are needed, better thousands: record for longer, "
            "and move the object or the camera meanwhile",
        )
    chosen = np.flatnonzero(usable)[:: -(-frames // _SAMPLE)]
    W, visible = dataset.points[chosen][:, counts], dataset.visible[chosen][:, counts]
    stacked = _filled(_stacked(W, visible), np.repeat(visible, 2, axis=0))
    U, values, _ = np.linalg.svd(stacked, full_matrices=False)
    values /= np.linalg.norm(values) or 1.0
    span = view_span(U[:, :3].reshape(-1, 2, 3))
    deformation = float(np.sqrt(max(0.0, 1 - (values[:3] ** 2).sum())))
    figures = (frames, keypoints, tuple(values.tolist()), span, deformation)
    refusal = _flatness(values)
    warnings = () if refusal else _warnings(frames, span, deformation, has_start, near_duplicates)
    if sides := mixed_sides(dataset):
        warnings = (*warnings, sides)
    return Sufficiency(*figures, refusal, warnings)


def view_span(motion: Floats) -> float:
    """Return the angle in degrees around the mean viewing direction that contains 90 % of views.

    The metric upgrade Q, with x Q x = y Q y = 1 and x Q y = 0, turns the rows into those of
    rotations.

    Args:
        motion: (f, 2, 3), two rows for each frame of the left factor of the stacked W.

    Source: Tomasi and Kanade, IJCV 1992.
    """
    x, y = motion[:, 0], motion[:, 1]
    i, j = np.triu_indices(3)
    weight = np.where(i == j, 0.5, 1.0)

    def products(a: Floats, b: Floats) -> Floats:
        terms: Floats = weight * (a[:, i] * b[:, j] + a[:, j] * b[:, i])
        return terms

    # The lengths are 1 on average, not in each frame: a side view may be smaller or larger.
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


def _refused(frames: int, keypoints: int, refusal: str) -> Sufficiency:
    """Return the refusal of a dataset too small to have a spectrum."""
    return Sufficiency(frames, keypoints, (), 0.0, 0.0, refusal, ())


def _flatness(values: Floats) -> str:
    """Return why the spectrum shows no depth; "" if it does."""
    tail = values[len(values) // 2 : -1]  # the last is 0, because the rows are centred
    noise = float(np.median(tail)) if len(values) >= 8 else 0.0
    if values[2] < max(_MIN_THIRD, _ABOVE_NOISE * noise):
        if noise > _MAX_NOISE:
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


def _warnings(
    frames: int, span: float, deformation: float, has_start: bool, near_duplicates: int
) -> tuple[str, ...]:
    """Return a sentence for each figure that may make the model poor."""
    warnings = []
    if frames < _FEW_FRAMES:
        others, differ = "", ""
        if near_duplicates > frames:
            others, differ = f", as {near_duplicates} more are near-duplicates", " that differ"
        warnings.append(
            f"{frames} frames are few{others}; expect a model of those frames alone, and record "
            f"thousands{differ} for a model of other frames too"
        )
    if span < _NARROW:
        views = f"the views span only {span:.0f} degrees around their mean"
        if span < 1:  # deformation hides a rotation that small, or looks like one
            views = "the frames look as if all were seen from one side"
        warnings.append(
            f"{views}, so that depth rests on the model that the training starts from; record the "
            "object from more sides to learn its depth"
            if has_start
            else f"{views}, so that depth rests on deformation alone and may come out mirrored; "
            + how_to_learn_depth()
        )
    if deformation < _RIGID:
        warnings.append(
            f"the object hardly deforms ({100 * deformation:.1f} % of the extent): expect one "
            "rigid shape; record it in other poses for more"
        )
    return tuple(warnings)


def how_to_learn_depth() -> str:
    """Return what helps where depth may come out mirrored, as a whole or in part."""
    a_model = "a model of such an object"
    start = wording(
        f"start from {a_model} (--from, train.from), or let the layout help (--bone-length-weight, "
        "--handedness-weight, or train.*)",
        node=f"start from {a_model} (train.from), or let the layout help "
        "(train.bone_length_weight, train.handedness_weight)",
        python=f"or start from {a_model} (start)",
    )
    return f"record the object from more sides, {start}"


def _stacked(points: NDArray[np.float32], visible: NDArray[np.bool_]) -> Floats:
    """Return W (2 f, p), rows x_1, y_1, x_2, ...; frames centred, of RMS radius 1."""
    mask = visible[..., None].astype(np.float64)
    X = centre_visible(points, mask)
    X = X / np.maximum(rms_radius(X, mask), 1e-9)
    rows: Floats = X.swapaxes(1, 2).reshape(-1, points.shape[1])
    return rows


def _filled(W: Floats, known: NDArray[np.bool_]) -> Floats:
    """Return W (2 f, p) with missing entries filled in by low rank, and its rows centred.

    The rank grows from one to three: with three from the start, the zeros of missing points would
    become a direction of their own.
    """
    filled = W
    if not known.all():
        for rank in (1, 2, 3):
            for _ in range(_ROUNDS):
                axes = np.linalg.eigh(filled.T @ filled)[1][:, -rank:]
                filled = np.where(known, W, filled @ axes @ axes.T)
    centred: Floats = filled - filled.mean(1, keepdims=True)
    return centred
