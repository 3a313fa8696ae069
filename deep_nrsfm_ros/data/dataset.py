"""The dataset: every observation of one object or object category, from whatever source."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.observation import Observation
from deep_nrsfm_ros.messages.serialised import SerialisedFormat

_BLOCK = 4096  # objects mapped and stored together
_RUN = 2**20  # bytes of messages of one make that are read together


@dataclass(frozen=True)
class Dataset:
    """The set of 2D projections that a model is trained on.

    points: (f, p, 2) float32, x right and y down, any unit; the values of missing points are 0.
    visible: (f, p) bool.
    layout: names of the p keypoints.
    source: where the frames come from, in words, for the provenance of a model.
    shapes: (f, p, 3) float32 ground truth in the frame of the data, or None. For evaluation
        only: nothing that trains reads it.
    """

    points: NDArray[np.float32]
    visible: NDArray[np.bool_]
    layout: KeypointLayout
    source: str
    shapes: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit each other or the layout."""
        f, p = len(self.points), len(self.layout)
        if self.points.shape != (f, p, 2):
            raise ValueError(f"points are {self.points.shape}; layout needs (frames, {p}, 2)")
        if self.visible.shape != (f, p):
            raise ValueError(f"visible is {self.visible.shape}; points need {(f, p)}")
        if self.shapes is not None and self.shapes.shape != (f, p, 3):
            raise ValueError(f"shapes are {self.shapes.shape}; points need {(f, p, 3)}")

    def __len__(self) -> int:
        """Return f, the number of frames."""
        return len(self.points)

    def __getitem__(self, frames: slice | NDArray[np.int64]) -> Dataset:
        """Return the dataset of the chosen frames."""
        shapes = None if self.shapes is None else self.shapes[frames]
        return Dataset(self.points[frames], self.visible[frames], self.layout, self.source, shapes)


def concatenate(datasets: list[Dataset]) -> Dataset:
    """Return all frames as one dataset; the layouts must be the same.

    The ground truth is kept only if every part has it. Raises ValueError for none, or for
    layouts that differ.
    """
    if not datasets:
        raise ValueError("no datasets to concatenate; name at least one bag or trial")
    layouts = {e.layout.keypoints for e in datasets}
    if len(layouts) > 1:
        raise ValueError(f"the sources have {len(layouts)} different keypoint layouts; use one")
    shapes = [e.shapes for e in datasets if e.shapes is not None]
    return Dataset(
        np.concatenate([e.points for e in datasets]),
        np.concatenate([e.visible for e in datasets]),
        datasets[0].layout,
        "; ".join(dict.fromkeys(e.source for e in datasets)),
        np.concatenate(shapes) if len(shapes) == len(datasets) else None,
    )


class DatasetBuilder:
    """Objects gathered block by block, so that memory holds arrays, not messages.

    count: how many there are.
    """

    def __init__(self, keypoint_map: KeypointMap, min_confidence: float) -> None:
        """Start empty; a keypoint of a message that is taken needs `min_confidence`."""
        self._map, self._min_confidence = keypoint_map, min_confidence
        self.count = 0
        self._make: SerialisedFormat | None = None
        self._run: list[bytes] = []  # messages of that make, not yet read
        self._waiting: list[Observation] = []  # not yet mapped
        self._objects = 0  # in those
        self._points: list[NDArray[np.float32]] = []
        self._visible: list[NDArray[np.bool_]] = []

    def take(self, make: SerialisedFormat, raw: bytes) -> None:
        """Append the objects of a message of a known make, to be read with others of it."""
        if make is not self._make or len(self._run) * len(raw) > _RUN:
            self._read()
            self._make = make
        self._run.append(raw)
        self.count += make.cloud.height

    def add(self, observation: Observation) -> None:
        """Append the objects of one observation."""
        self._read()
        self._wait(observation)
        self.count += len(observation.confidence)

    def _read(self) -> None:
        """Read the run."""
        if self._make and self._run:
            self._wait(self._make.read(self._run, self._min_confidence))
            self._run.clear()

    def _wait(self, observation: Observation) -> None:
        """Keep the objects of one observation until there are enough to map."""
        self._waiting.append(observation)
        self._objects += len(observation.confidence)
        if self._objects + len(self._waiting) >= _BLOCK:  # some show none
            self._store()

    def _store(self) -> None:
        """Map what is waiting to the target layout."""
        if self._waiting:
            points = np.concatenate([seen.points for seen in self._waiting])
            confidence = np.concatenate([seen.confidence for seen in self._waiting])
            points, confidence = self._map(points, confidence)
            self._points.append(points)
            self._visible.append(confidence > 0)
            self._waiting.clear()
            self._objects = 0

    def dataset(self, source: str) -> Dataset:
        """Return everything that was taken and added, in that order."""
        self._read()
        self._store()
        points, visible = np.concatenate(self._points), np.concatenate(self._visible)
        return Dataset(points, visible, self._map.target, source)
