# SPDX-License-Identifier: Apache-2.0
"""Which frames a model has learned: a model is at an advantage on frames of its own training.

The provenance of a model keeps marks of its frames: numbers of 32 bits that are computed from the
keypoints, and are the same for a frame that is moved, scaled or mirrored. They say whether a frame
was among them, and nothing else of it.
"""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.batched import slices
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap, TooFewSharedError
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.geometry import centre_visible

LEARNED_FRAMES = "learned_frames"
"""Key of a provenance: the marks of the frames that a model has learned, as text."""

_MOST_MARKS = 4096  # that a model keeps: the least ones, so that two models keep the same
_GRID = 1 / 32  # of the size of an object, to which keypoints are rounded
_LEARNED_SHARE = 0.1
"""Share of a recording's frames that a model must know for all of them to count as learned.

A mark changes where a keypoint was hidden as an outlier, or was rounded otherwise.
"""

Marks = NDArray[np.uint32]


def frame_marks(points: NDArray[Any], visible: NDArray[np.bool_]) -> Marks:
    """Return the marks (f,) of frames.

    Args:
        points: (f, p, 2) keypoints, in any unit.
        visible: (f, p) bool; hidden keypoints do not count.
    """
    f, p = visible.shape
    factors = np.random.default_rng(0).integers(1, 2**63, (2, p, 2), np.uint64) | np.uint64(1)
    marks = np.empty(f, np.uint32)
    for part in slices(f):
        seen = np.asarray(visible[part], bool)[..., None]
        X = centre_visible(np.asarray(points[part], np.float64), seen.astype(float)) * seen
        count = np.maximum(seen.sum((1, 2)), 1)
        size = np.sqrt((X**2).sum((1, 2)) / count)
        cells = np.rint(X / (_GRID * np.maximum(size, 1e-12)[:, None, None])).astype(np.int64)
        both = []
        for side in ([1, 1], [-1, 1]):  # of a frame and its mirror image
            terms = (cells * side).astype(np.uint64) * factors[0] + factors[1] * seen
            both.append(_mixed(terms.sum((1, 2), dtype=np.uint64)))
        marks[part] = (np.minimum(*both) >> np.uint64(32)).astype(np.uint32)
    return marks


def _mixed(sums: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return numbers whose high bits depend on all bits of the given ones."""
    shift, factor = np.uint64(32), np.uint64(0xD6E8FEB86659FD93)
    for _ in range(2):
        sums = (sums ^ (sums >> shift)) * factor
    return sums ^ (sums >> shift)


def marks_in_words(marks: Marks) -> str:
    """Return the text for a provenance; of many marks it holds the least ones."""
    return base64.b64encode(np.unique(marks)[:_MOST_MARKS].astype("<u4").tobytes()).decode()


def joined_marks(model: Model, start: Model) -> str:
    """Return the text for a model that has learned what its start had learned, and more."""
    return marks_in_words(np.concatenate([_marks(model), _marks(start)]))


def _marks(model: Model) -> Marks:
    """Return the marks of a model; none where its file has no such text."""
    text = model.provenance.get(LEARNED_FRAMES)
    try:
        raw = base64.b64decode(text, validate=True) if isinstance(text, str) else b""
        return np.frombuffer(raw, "<u4").astype(np.uint32)
    except ValueError:  # of a damaged file
        return np.empty(0, np.uint32)


def learned_by(model: Model, dataset: Dataset) -> NDArray[np.bool_]:
    """Return which frames (f,) of a dataset a model has learned, by itself or by its start.

    Of a recording of which it has learned a tenth, it has learned all: frames between those of a
    training look like these.

    Args:
        model: with any provenance; one without marks has learned none, for all that is known.
        dataset: the frames, in any layout.
    """
    learned, f = np.zeros(len(dataset), bool), len(dataset)
    known = _marks(model)
    if not len(known) or not f:
        return learned
    try:
        to_model = KeypointMap(dataset.layout, model.layout)
    except TooFewSharedError:
        return learned
    points, confidence = to_model(dataset.points, dataset.visible.astype(np.float32))
    marks = frame_marks(points, confidence > 0)
    # Of many frames only the least marks are kept, so only frames with such marks tell.
    tells = marks <= known.max() if len(known) >= _MOST_MARKS else np.ones(f, bool)
    found = np.isin(marks, known)
    if not tells.any():
        return learned
    whole = found.sum() >= max(1, _LEARNED_SHARE * tells.sum())
    starts = dataset.sequence_starts if len(dataset.sequence_starts) else np.zeros(1, np.int64)
    for first, end in zip(starts, [*starts[1:], f], strict=True):
        rows = slice(first, end)
        count = tells[rows].sum()
        if count:
            learned[rows] = found[rows].sum() >= max(1, _LEARNED_SHARE * count)
        else:
            learned[rows] = whole
    return learned
