# SPDX-License-Identifier: Apache-2.0
"""The dataset: 2D keypoints of one object or object category in many frames, from any source."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.large_arrays import concatenated, empty, release, take
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.observation import Observation
from deep_nrsfm_ros.messages.serialised import SerialisedFormat

_BLOCK = 4096  # objects that are mapped and stored together
_CHUNK = 2**18  # objects that are put into files together
_RUN_BYTES = 2**20  # messages of one format that are read together


@dataclass(frozen=True)
class Dataset:
    """The f frames that a model is trained on, each with p keypoints of one object.

    Attributes:
        points: (f, p, 2) float32, x right and y down, in any unit; 0 where missing.
        visible: (f, p) bool, False where missing.
        layout: names of the p keypoints.
        source: where the frames come from, in words, for the provenance of a model.
        shapes: (f, p, 3) float32 ground truth in the axes of the data, or None. Only evaluation
            reads it, training never does.
        sequence_starts: (s,) int64, ascending from 0, first frames of the sequences: recordings,
            views or identities, the frames of each in the order of their time. Empty: unknown.
        is_one_side: whether hands are said to be right ones, or were made so; see `data.hands`.
        cameras: (f, 3, 2) float32 M of the ground truth, points = shapes @ cameras, or None.
    """

    points: NDArray[np.float32]
    visible: NDArray[np.bool_]
    layout: KeypointLayout
    source: str
    shapes: NDArray[np.float32] | None = None
    sequence_starts: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    is_one_side: bool = False
    cameras: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        """Raise ValueError if the shapes of the arrays do not match each other or the layout."""
        f, p = len(self.points), len(self.layout)
        if self.points.shape != (f, p, 2):
            raise ValueError(f"points are {self.points.shape}; layout needs (frames, {p}, 2)")
        if self.visible.shape != (f, p):
            raise ValueError(f"visible is {self.visible.shape}; points need {(f, p)}")
        if self.shapes is not None and self.shapes.shape != (f, p, 3):
            raise ValueError(f"shapes are {self.shapes.shape}; points need {(f, p, 3)}")
        if self.cameras is not None and self.cameras.shape != (f, 3, 2):
            raise ValueError(f"cameras are {self.cameras.shape}; points need {(f, 3, 2)}")

        starts = self.sequence_starts
        if len(starts) and (starts[0] or starts[-1] >= f or (np.diff(starts) <= 0).any()):
            raise ValueError(f"sequence_starts {starts} must ascend from 0, to a frame of the {f}")

    def __len__(self) -> int:
        """Return f, the number of frames."""
        return len(self.points)

    def __getitem__(self, frames: slice | NDArray[np.int64]) -> Dataset:
        """Return the dataset of a slice, or of indices, of the frames.

        The arrays of indices are copies, in files where they are large.
        """

        def chosen(array: NDArray[Any]) -> NDArray[Any]:
            return array[frames] if isinstance(frames, slice) else take(array, frames)

        truth = (None if each is None else chosen(each) for each in (self.shapes, self.cameras))
        shapes, cameras = truth
        points, visible = chosen(self.points), chosen(self.visible)
        starts = self.sequence_starts
        if len(starts):
            sequence = np.searchsorted(starts, np.arange(len(self))[frames], "right")
            starts = np.flatnonzero(np.diff(sequence, prepend=-1))
        return Dataset(
            points, visible, self.layout, self.source, shapes, starts, self.is_one_side, cameras
        )


def concatenate(datasets: list[Dataset]) -> Dataset:
    """Return the frames of all datasets as one.

    Args:
        datasets: at least one, all of the same layout. The result has a ground truth only if
            all of them have one, and sequences only if all have them.

    Raises:
        ValueError: there is no dataset, or the layouts differ.
    """
    if not datasets:
        raise ValueError("no datasets to concatenate; name at least one bag or trial")
    layouts = {e.layout.keypoints for e in datasets}
    if len(layouts) > 1:
        raise ValueError(f"the sources have {len(layouts)} different keypoint layouts; use one")
    shapes = [e.shapes for e in datasets if e.shapes is not None]
    cameras = [e.cameras for e in datasets if e.cameras is not None]
    first = np.cumsum([0, *(len(e) for e in datasets)])
    has_starts = all(len(e.sequence_starts) or not len(e) for e in datasets)
    starts = [e.sequence_starts + at for e, at in zip(datasets, first[:-1], strict=True)]
    return Dataset(
        concatenated([e.points for e in datasets]),
        concatenated([e.visible for e in datasets]),
        datasets[0].layout,
        "; ".join(dict.fromkeys(e.source for e in datasets)),
        concatenated(shapes) if len(shapes) == len(datasets) else None,
        np.concatenate(starts) if has_starts else np.empty(0, np.int64),
        cameras=concatenated(cameras) if len(cameras) == len(datasets) else None,
    )


class DatasetBuilder:
    """Builds a dataset from messages, block by block, so that memory holds arrays, not messages.

    Large datasets are in temporary files (`large_arrays`).

    Attributes:
        count: number of objects added.
    """

    def __init__(self, keypoint_map: KeypointMap, min_confidence: float) -> None:
        """Start with an empty dataset.

        Args:
            keypoint_map: from the layout of the messages to the layout of the dataset.
            min_confidence: keypoints of serialised messages below it are missing.
        """
        self._map, self._min_confidence = keypoint_map, min_confidence
        self.count = 0
        self._format: SerialisedFormat | None = None
        self._run: list[bytes] = []  # messages of that format, not yet read
        self._pending: list[Observation] = []  # not yet mapped
        self._pending_objects = 0
        self._points: list[NDArray[np.float32]] = []
        self._visible: list[NDArray[np.bool_]] = []
        self._unsaved = 0  # objects in them
        self._saved: tuple[list[NDArray[Any]], list[NDArray[Any]]] = ([], [])
        self._starts: list[int] = []

    def begin_sequence(self) -> None:
        """Mark the next object as the first of a sequence: a recording, or one of its topics."""
        self._starts.append(self.count)

    def add_serialised(self, known_format: SerialisedFormat, raw: bytes) -> None:
        """Add the objects of a serialised message; messages of one format are read together."""
        if known_format is not self._format or len(self._run) * len(raw) > _RUN_BYTES:
            self._read_run()
            self._format = known_format
        self._run.append(raw)
        self.count += known_format.cloud.height

    def add(self, observation: Observation) -> None:
        """Add the objects of one observation."""
        self._read_run()
        self._add_pending(observation)
        self.count += len(observation.confidence)

    def _read_run(self) -> None:
        """Read the serialised messages of the run."""
        if self._format and self._run:
            self._add_pending(self._format.read(self._run, self._min_confidence))
            self._run.clear()

    def _add_pending(self, observation: Observation) -> None:
        """Keep an observation until there are enough objects to map."""
        self._pending.append(observation)
        self._pending_objects += len(observation.confidence)
        # Observations without an object count too: they take memory.
        if self._pending_objects + len(self._pending) >= _BLOCK:
            self._map_pending()

    def _map_pending(self) -> None:
        """Map the pending observations to the layout of the dataset."""
        if self._pending:
            points = np.concatenate([each.points for each in self._pending])
            confidence = np.concatenate([each.confidence for each in self._pending])
            points, confidence = self._map(points, confidence)
            self._points.append(points)
            self._visible.append(confidence > 0)
            self._unsaved += len(points)
            if self._unsaved >= _CHUNK:
                self._save()
            self._pending.clear()
            self._pending_objects = 0

    def _save(self) -> None:
        """Put the mapped objects together, into files if they are large."""
        if self._points:
            arrays = (np.concatenate(self._points), np.concatenate(self._visible))
            for array, saved in zip(arrays, self._saved, strict=True):
                chunk = empty(array.shape, array.dtype)
                chunk[:] = array
                release((chunk,))
                saved.append(chunk)
        self._points, self._visible, self._unsaved = [], [], 0

    def dataset(self, source: str) -> Dataset:
        """Return the dataset of all objects, in the order in which they were added."""
        self._read_run()
        self._map_pending()
        self._save()
        points, visible = map(concatenated, self._saved)
        starts = np.unique(np.array([at for at in self._starts if at < len(points)], np.int64))
        return Dataset(points, visible, self._map.target, source, sequence_starts=starts)
