"""What of a dataset is fit to be learned from: the rest is left out, counted and shown."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.batched import slices
from deep_nrsfm_ros.configuration import check, option
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.outliers import find_outliers

Bools = NDArray[np.bool_]

_RECENT = 4  # kept frames that a frame is compared with: several objects may take turns
_HOPELESS = 0.25  # share of a frame's visible points that may be outliers
_EXAMPLES = 12  # worst frames that are kept for show
_APART = 0.005  # of the data, by which they are
_SUSPICIOUS = 0.1  # share of the data from which on curation itself is in doubt


@dataclass(frozen=True)
class Curation:
    """Curation."""

    min_visible: int = option(
        4, "frames with fewer visible keypoints are left out; 0 keeps all", low=0, high=1000
    )
    min_change: float = option(
        0.02,
        "frames that differ from one kept just before by less than this share of the object's "
        "size (a still camera on a still object) are left out; 0 keeps all",
        low=0.0,
        high=1.0,
    )
    outlier_threshold: float = option(
        6.0,
        "keypoints that deviate from what the others of their frame foretell by more than so many "
        "times the usual (swaps, jumps) are hidden; 0 keeps all",
        low=0.0,
        high=1000.0,
    )


KEEP_ALL = Curation(min_visible=0, min_change=0.0, outlier_threshold=0.0)
"""Everything turned off."""


@dataclass(frozen=True)
class OutlierFrame:
    """A frame with outliers.

    frame: its place in the data as given. points: (p, 2) and visible: (p,) as given.
    outliers: (p,) which points were found. deviation: of the worst, in usual deviations.
    dropped: the whole frame was left out, as too little of it agrees with the rest.
    """

    frame: int
    points: NDArray[np.float32]
    visible: Bools
    outliers: Bools
    deviation: float
    dropped: bool


@dataclass(frozen=True)
class Curated:
    """What is left of a dataset, and what became of the rest.

    frames: (f,) where each frame of `dataset` was among all `total` ones.
    few_visible, near_duplicates, inconsistent: frames left out, each counted once.
    hidden: (p,) how often each keypoint was hidden in frames that stayed, which are `corrected`.
    outlier_frames: some frames with outliers, the worst first.
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
        """Return one sentence with every count, "" if nothing was touched."""
        out = {
            "with too few visible keypoints": self.few_visible,
            "near-duplicates": self.near_duplicates,
            "that contradict the rest": self.inconsistent,
        }
        parts = [f"{count} {what}" for what, count in out.items() if count]
        sentences = [f"left out {', '.join(parts)}"] if parts else []
        if self.corrected:
            hidden = self.hidden.sum()
            sentences.append(f"hid {hidden} outlying keypoints in {self.corrected} frames")
        return f"of {self.total} frames, {'; '.join(sentences)}" if sentences else ""

    @property
    def hidden_by_name(self) -> list[tuple[str, int, int]]:
        """Return (keypoint, times hidden, times seen before that), in order of the layout."""
        names = self.dataset.layout.keypoints
        seen = self.dataset.visible.sum(0) + self.hidden
        return list(zip(names, self.hidden.tolist(), seen.tolist(), strict=True))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return a sentence for each count that is suspiciously high."""
        found = []
        judged = self.total - self.few_visible - self.near_duplicates
        if self.few_visible > 0.5 * self.total:
            found.append(
                f"{self.few_visible} of {self.total} frames show too few keypoints; look at the "
                "detector, --min-confidence and the keypoint layout"
            )
        if self.inconsistent > _SUSPICIOUS * judged:
            found.append(
                f"{self.inconsistent} of {judged} frames contradict the rest; if they are rare "
                "poses and not mistakes of the detector, --outlier-threshold 0 keeps them"
            )
        seen = self.dataset.visible.sum(0) + self.hidden
        for name, count, total in zip(
            self.dataset.layout.keypoints, self.hidden, seen, strict=True
        ):
            if count > _SUSPICIOUS * total:
                found.append(f"{name} was an outlier in {count} of {total} frames: is it swapped?")
        return tuple(found)


def curate(dataset: Dataset, options: Curation | None = None) -> Curated:
    """Return what is fit to be learned from, by `options` (all defaults if None).

    Frames keep their order; the ground truth, if any, goes with them and is not looked at.
    Raises ValueError when an option is out of range or no frame shows enough keypoints.
    """
    options = options or Curation()
    check(options)
    enough = dataset.visible.sum(1) >= options.min_visible
    if not enough.any():
        raise ValueError(
            f"none of the {len(dataset)} frames shows {options.min_visible} keypoints; look at "
            "the detector, --min-confidence and the keypoint layout"
        )
    frames = np.flatnonzero(enough)
    if options.min_change:
        points, visible = dataset.points[frames], dataset.visible[frames]
        frames = frames[changed_frames(points, visible, options.min_change)]
    judged, visible = len(frames), dataset.visible[frames]
    outliers: Bools = np.zeros_like(visible)
    worst: NDArray[np.float64] = np.zeros(judged)
    if options.outlier_threshold:
        outliers, worst = find_outliers(dataset.points[frames], visible, options.outlier_threshold)
    number = outliers.sum(1)
    stay = (number <= _HOPELESS * visible.sum(1)) & (
        (number == 0) | (visible.sum(1) - number >= options.min_visible)
    )
    order = np.argsort(-worst, kind="stable")
    suspects = tuple(
        OutlierFrame(
            int(frames[i]),
            dataset.points[frames[i]],
            visible[i],
            outliers[i],
            float(worst[i]),
            not stay[i],
        )
        for i in spread_out(order, frames, _APART * len(dataset), _EXAMPLES)
        if number[i]
    )
    kept = dataset[frames[stay]]
    kept.visible[outliers[stay]] = False
    kept.points[~kept.visible] = 0
    return Curated(
        kept,
        frames[stay],
        len(dataset),
        int((~enough).sum()),
        int(enough.sum()) - judged,
        int((~stay).sum()),
        int((number[stay] > 0).sum()),
        outliers[stay].sum(0),
        suspects,
    )


def spread_out(
    order: NDArray[np.int64], frames: NDArray[np.int64], gap: float, most: int
) -> list[int]:
    """Return the first of `order` whose frames are more than `gap` frames from each other.

    order: indices into frames (f,). The neighbours of a frame show the same thing once more.
    """
    chosen: list[int] = []
    for i in order.tolist():
        if all(abs(int(frames[i] - frames[j])) > gap for j in chosen):
            chosen.append(i)
            if len(chosen) == most:
                break
    return chosen


def changed_frames(points: NDArray[np.float32], visible: Bools, least: float) -> Bools:
    """Tell (f,) which of the frames (f, p, 2) differ from the few kept before them.

    A frame that shows no other keypoints than a kept one, and whose points, centred and scaled by
    their RMS radius, are within `least` (RMS) of it, says nothing new.
    """
    kept = np.zeros(len(points), bool)
    recent: deque[_Kept] = deque(maxlen=_RECENT)
    for part in slices(len(points)):
        seen = visible[part]
        fitted = _fitted(points[part], seen)
        patterns = (int.from_bytes(row) for row in np.packbits(seen, 1))
        for i, now, pattern in zip(range(part.start, part.stop), fitted, patterns, strict=True):
            closest = least**2 * pattern.bit_count()
            for before in recent:
                if pattern & ~before.pattern:
                    continue
                then = before.fitted
                if pattern != before.pattern:
                    then = _fitted(points[before.frame], visible[i])
                away = (now - then).ravel()
                if away @ away < closest:
                    break
            else:
                kept[i] = True
                recent.append(_Kept(i, pattern, now))
    return kept


class _Kept(NamedTuple):
    """A frame that was kept: which, its visible points as bits, and as `_fitted` has it."""

    frame: int
    pattern: int
    fitted: NDArray[np.float32]


def _fitted(points: NDArray[np.float32], visible: Bools) -> NDArray[np.float32]:
    """Return points (..., p, 2), the visible centred and with RMS radius 1, the others 0."""
    there = visible[..., None].astype(np.float32)
    number = np.maximum(there.sum(-2, keepdims=True), 1)
    X = np.where(visible[..., None], points, np.float32(0))
    X = (X - X.sum(-2, keepdims=True) / number) * there
    radius = np.sqrt((X * X).sum((-2, -1), keepdims=True) / number)
    fitted: NDArray[np.float32] = X / np.maximum(radius, np.float32(1e-9))
    return fitted
