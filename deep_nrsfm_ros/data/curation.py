# SPDX-License-Identifier: Apache-2.0
"""Filter a dataset for training; count and report what was dropped."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.batched import Progress, no_progress, slices
from deep_nrsfm_ros.configuration import check, described, option
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.outliers import find_outliers
from deep_nrsfm_ros.large_arrays import empty, release
from deep_nrsfm_ros.nrsfm.geometry import centre_visible, rms_radius
from deep_nrsfm_ros.wording import wording

Bools = NDArray[np.bool_]

_RECENT = 4  # kept frames that a frame is compared with: frames of several objects may alternate
_MAX_OUTLIER_SHARE = 0.25  # of a frame's visible keypoints; frames with more are dropped
_EXAMPLES = 12  # worst frames with outliers that are kept for the report
_MIN_GAP = 0.005  # between two of these frames, as a share of the data
_SUSPICIOUS = 0.1  # share of the data above which a count gets a warning


@dataclass(frozen=True)
@described
class Curation:
    """Curation."""

    min_visible: int = option(
        4,
        "least number of visible keypoints of a frame; frames with fewer are left out; 0 = keep "
        "all, 4 typical",
        low=0,
        high=1000,
    )
    min_change: float = option(
        0.02,
        "least RMS change between a frame and the frames kept shortly before it, relative to the "
        "size of the object; frames with less change, e.g. of a still object, are left out; "
        "0 = keep all, 0.02 typical, 0.1 strong",
        low=0.0,
        high=1.0,
    )
    outlier_threshold: float = option(
        6.0,
        "Mahalanobis distance between a keypoint and its prediction from the frame's other "
        "keypoints, in typical distances of that keypoint, above which it is hidden, e.g. a left "
        "and right that are swapped; 0 = keep all, 6 typical, 3 strong",
        low=0.0,
        high=1000.0,
    )
    held_out: float = option(
        0.1,
        "share of the frames that the training does not use, and on which the new model is judged: "
        "the last ones of each recording or identity, after a gap of half as many frames, which "
        "nothing uses; 0, or fewer than 20 frames (50 where the object has no model) = none, the "
        "model is judged on the frames of its training; 0.1 typical",
        low=0.0,
        high=0.5,
    )


KEEP_ALL = Curation(min_visible=0, min_change=0.0, outlier_threshold=0.0, held_out=0.0)
"""Curation that keeps all frames and keypoints."""


@dataclass(frozen=True)
class OutlierFrame:
    """A frame with outliers.

    Attributes:
        frame: its index in the dataset before curation.
        points: (p, 2) its keypoints before curation.
        visible: (p,) its visible keypoints before curation.
        outliers: (p,) which of them are outliers.
        deviation: Mahalanobis distance of the worst keypoint, in typical distances.
        dropped: True if the whole frame was left out, because it has too many outliers.
    """

    frame: int
    points: NDArray[np.float32]
    visible: Bools
    outliers: Bools
    deviation: float
    dropped: bool


@dataclass(frozen=True)
class Curated:
    """A curated dataset, and what was dropped. Each dropped frame is counted once.

    Attributes:
        dataset: the frames that were kept, without outliers.
        frames: (f,) index of each of them before curation.
        total: number of frames before curation.
        few_visible: frames dropped because they have too few visible keypoints.
        near_duplicates: frames dropped because they hardly differ from an earlier one.
        inconsistent: frames dropped because they have too many outliers.
        corrected: frames that were kept with some of their keypoints hidden.
        hidden: (p,) number of frames in which each keypoint was hidden.
        outlier_frames: some frames with outliers, the worst first, for the report.
    """

    dataset: Dataset
    frames: NDArray[np.int64]
    total: int
    few_visible: int
    near_duplicates: int
    inconsistent: int
    corrected: int
    hidden: NDArray[np.int64]
    outlier_frames: tuple[OutlierFrame, ...]

    @property
    def summary(self) -> str:
        """Return one sentence with every count; "" if nothing was dropped or hidden."""
        dropped = {
            "with too few visible keypoints": self.few_visible,
            f"near-duplicates{_keep_duplicates()}": self.near_duplicates,
            "that contradict the rest": self.inconsistent,
        }
        parts = [f"{count} {reason}" for reason, count in dropped.items() if count]
        sentences = [f"left out {', '.join(parts)}"] if parts else []
        if self.corrected:
            hidden = self.hidden.sum()
            sentences.append(f"hid {hidden} outlying keypoints in {self.corrected} frames")
        return f"of {self.total} frames, {'; '.join(sentences)}" if sentences else ""

    @property
    def hidden_by_keypoint(self) -> list[tuple[str, int, int]]:
        """Return (keypoint, frames where hidden, frames where visible before), in layout order."""
        names = self.dataset.layout.keypoints
        visible = self.dataset.visible.sum(0) + self.hidden
        return list(zip(names, self.hidden.tolist(), visible.tolist(), strict=True))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return a sentence for each count that is suspiciously high."""
        warnings = []
        judged = self.total - self.few_visible - self.near_duplicates
        if self.few_visible > 0.5 * self.total:
            warnings.append(
                f"{self.few_visible} of {self.total} frames show too few keypoints; "
                + _look_at_the_detector()
            )
        if self.inconsistent > _SUSPICIOUS * judged:
            warnings.append(
                f"{self.inconsistent} of {judged} frames contradict the rest; if they are rare "
                "poses and not mistakes of the detector, "
                + wording(
                    "--outlier-threshold 0 keeps them",
                    node="train.outlier_threshold 0 keeps them",
                    python="the program `train` can keep them",
                )
            )
        for name, count, total in self.hidden_by_keypoint:
            if count > _SUSPICIOUS * total:
                warnings.append(
                    f"{name} was an outlier in {count} of {total} frames: is it swapped?"
                )
        return tuple(warnings)


def _keep_duplicates() -> str:
    """Return how near-duplicates are kept."""
    return wording(
        " (--min-change 0, train.min_change 0: keep them)",
        node=" (train.min_change 0 keeps them)",
        python="",
    )


def _look_at_the_detector() -> str:
    """Return what to do about frames with few keypoints."""
    confidence = wording("--min-confidence", node="min_confidence", python="the confidence")
    return f"look at the detector, {confidence} and the keypoint layout"


def curate(
    dataset: Dataset, options: Curation | None = None, on_progress: Progress = no_progress
) -> Curated:
    """Return a dataset without poor frames, near duplicates and outliers.

    Frames keep their order and their ground truth, which has no influence. Deterministic.

    Args:
        dataset: is not changed.
        options: what to drop; None = defaults.
        on_progress: called after each few thousand frames of both passes, in each of which a frame
            counts half; an exception ends the curation.

    Raises:
        ValueError: an option is out of range, or no frame has enough visible keypoints.
    """
    options = options or Curation()
    check(options)
    enough = dataset.visible.sum(1) >= options.min_visible
    if not enough.any():
        raise ValueError(
            f"none of the {len(dataset)} frames shows {options.min_visible} keypoints; "
            + _look_at_the_detector()
        )
    frames = np.flatnonzero(enough)
    candidates, count = dataset if enough.all() else dataset[frames], len(frames)
    if options.min_change:
        changed = changed_frames(
            candidates.points,
            candidates.visible,
            options.min_change,
            lambda done, total: on_progress(done // 2, total),
        )
        if not changed.all():
            frames = frames[changed]
            candidates = dataset[frames]
    visible = candidates.visible
    outliers: Bools = empty(visible.shape, bool)
    outliers[:] = False
    worst: NDArray[np.float64] = np.zeros(len(frames))
    if options.outlier_threshold:
        outliers, worst = find_outliers(
            candidates.points,
            visible,
            options.outlier_threshold,
            lambda done, total: on_progress((count + round(count * done / total)) // 2, count),
        )
    number = outliers.sum(1)
    keep = (number <= _MAX_OUTLIER_SHARE * visible.sum(1)) & (
        (number == 0) | (visible.sum(1) - number >= options.min_visible)
    )
    order = np.argsort(-worst, kind="stable")
    examples = tuple(
        OutlierFrame(
            int(frames[i]),
            dataset.points[frames[i]],
            visible[i],
            outliers[i],
            float(worst[i]),
            not keep[i],
        )
        for i in spread_out(order, frames, _MIN_GAP * len(dataset), _EXAMPLES)
        if number[i]
    )
    kept = dataset[frames[keep]]  # a copy, which may be changed
    rows = np.flatnonzero(keep)
    hidden = np.zeros(visible.shape[1], np.int64)
    for part in slices(len(rows)):
        wrong = outliers[rows[part]]
        kept.visible[part] &= ~wrong
        kept.points[part][~kept.visible[part]] = 0
        hidden += wrong.sum(0)
    release((kept.points, kept.visible))
    return Curated(
        dataset=kept,
        frames=frames[keep],
        total=len(dataset),
        few_visible=int((~enough).sum()),
        near_duplicates=int(enough.sum()) - len(frames),
        inconsistent=int((~keep).sum()),
        corrected=int((number[keep] > 0).sum()),
        hidden=hidden,
        outlier_frames=examples,
    )


def spread_out(
    order: NDArray[np.int64], frames: NDArray[np.int64], gap: float, most: int
) -> list[int]:
    """Return the first indices of `order` whose frames are more than `gap` apart.

    Neighbouring frames look alike, so that one of them is enough as an example.

    Args:
        order: indices into `frames`, the most interesting first.
        frames: (f,) frame numbers.
        gap: least difference between two chosen frame numbers, exclusive.
        most: number of indices to return at most.
    """
    chosen: list[int] = []
    for i in map(int, order):
        if all(abs(int(frames[i] - frames[j])) > gap for j in chosen):
            chosen.append(i)
            if len(chosen) == most:
                break
    return chosen


def changed_frames(
    points: NDArray[np.float32],
    visible: Bools,
    min_change: float,
    on_progress: Progress = no_progress,
) -> Bools:
    """Return which frames (f,) differ from the few frames kept before them.

    A frame is a near duplicate if all its visible keypoints are visible in a kept frame too, and
    the RMS distance between the two is below `min_change`, after centring and scaling.

    Args:
        points: (f, p, 2), in any unit.
        visible: (f, p).
        min_change: in RMS radii of the object, e.g. 0.02.
        on_progress: called with the frames done and f.
    """
    kept = np.zeros(len(points), bool)
    recent: deque[_Kept] = deque(maxlen=_RECENT)
    row = 0  # kept frames since the last one that was not
    for part in slices(len(points)):
        scaled, shown = _scaled(points[part], visible[part]), np.packbits(visible[part], 1)
        may_be_near = _may_be_near(scaled, points[part], visible[part], min_change)
        near = [*np.flatnonzero(may_be_near).tolist(), len(scaled)]
        frames = range(len(scaled))
        i = 0
        while i < len(scaled):
            # Where the frames just before are kept, so are all up to the next that may be near.
            clear = near[bisect_left(near, i)] - i if row >= _RECENT else 0
            new = frames[i : i + max(clear, 1)]
            last = [
                _Kept(part.start + k, int.from_bytes(shown[k]), scaled[k]) for k in new[-_RECENT:]
            ]
            if clear or not any(
                _is_near(last[0], other, points, visible, min_change) for other in recent
            ):
                kept[part.start + new.start : part.start + new.stop] = True
                recent.extend(last)
                row += len(new)
            else:
                row = 0
            i = new.stop
        on_progress(part.stop, len(points))
    return kept


def _may_be_near(
    scaled: NDArray[np.float32], points: NDArray[np.float32], visible: Bools, min_change: float
) -> Bools:
    """Return which frames are near duplicates of one of the few frames before them.

    Args:
        scaled: (f, p, 2) from `_scaled`.
        points: (f, p, 2), in any unit.
        visible: (f, p).
        min_change: in RMS radii of the object.

    Returns:
        (f,) also True where rounding may decide, and for the first few, of which not all frames
        before are here.
    """
    near = np.arange(len(scaled)) < _RECENT
    limit = 1.001 * min_change**2 * visible.sum(1)
    for lag in range(1, _RECENT + 1):
        rows = np.arange(_RECENT, len(scaled))
        rows = rows[~(visible[rows] & ~visible[rows - lag]).any(1)]  # the others cannot be
        reference = scaled[rows - lag]
        fewer = np.flatnonzero((visible[rows] != visible[rows - lag]).any(1))
        reference[fewer] = _scaled(points[rows[fewer] - lag], visible[rows[fewer]])
        difference = scaled[rows] - reference
        near[rows] |= np.einsum("fpc,fpc->f", difference, difference) < limit[rows]
    return near


def _is_near(
    new: _Kept, other: _Kept, points: NDArray[np.float32], visible: Bools, min_change: float
) -> bool:
    """Return whether a frame is a near duplicate of a kept one; see `changed_frames`."""
    if new.pattern & ~other.pattern:
        return False
    reference = other.scaled
    if new.pattern != other.pattern:  # compare the keypoints that both show
        reference = _scaled(points[other.frame], visible[new.frame])
    difference = (new.scaled - reference).ravel()
    return bool(difference @ difference < min_change**2 * new.pattern.bit_count())


class _Kept(NamedTuple):
    """A kept frame: its index, its visible keypoints as bits, and its points from `_scaled`."""

    frame: int
    pattern: int
    scaled: NDArray[np.float32]


def _scaled(points: NDArray[np.float32], visible: Bools) -> NDArray[np.float32]:
    """Return points (..., p, 2) centred and of RMS radius 1 over the visible; 0 where missing."""
    mask = visible[..., None].astype(np.float32)
    X = centre_visible(np.where(visible[..., None], points, np.float32(0)), mask)
    scaled: NDArray[np.float32] = X / np.maximum(rms_radius(X, mask), np.float32(1e-9))
    return scaled
