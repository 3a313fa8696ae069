"""A recording and what came of it: 2D keypoints as seen, 3D shapes as lifted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.detections import Detections, gather
from deep_nrsfm_ros.data.lifted_bags import LiftedMessage
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter, lift_all
from deep_nrsfm_ros.lifting.observation import Observation
from deep_nrsfm_ros.lifting.perspective import lift_perspective
from deep_nrsfm_ros.nrsfm.geometry import centre, weak_perspective

_TOGETHER = 50_000_000  # ns within which an answer and keypoints are of one frame


@dataclass(frozen=True)
class Recording:
    """The m objects of a recording.

    `detections` are in the layout `source`, `lifted` in the layout `target`. Objects that were
    not lifted are NaN with confidence 0.
    """

    source: KeypointLayout
    target: KeypointLayout
    detections: Detections
    lifted: Lifted

    @property
    def is_lifted(self) -> NDArray[np.bool_]:
        """Tell (m,) which objects were lifted."""
        sound: NDArray[np.bool_] = ~np.isnan(self.lifted.shapes.sum((1, 2)))
        return sound


def lift_recording(
    seen: Detections,
    source: KeypointLayout,
    lifter: Lifter,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    intrinsics: Intrinsics | None = None,
) -> Recording:
    """Lift everyone in `seen`, whose keypoints are those of `source`.

    intrinsics: of the camera, for the shapes to be at their place; None: they are centred. Raises
    ValueError if too few of them are the model's.
    """
    target = lifter.model.layout
    points, confidence = KeypointMap(source, target)(seen.points, seen.confidence)
    lift = partial(lift_perspective, lifter, intrinsics) if intrinsics else lifter.lift
    return Recording(source, target, seen, lift_all(lift, points, confidence, on_progress))


def join_lifted_messages(
    answers: Sequence[LiftedMessage],
    seen: Detections | None,
    source: KeypointLayout,
    target: KeypointLayout,
) -> Recording:
    """Return what a lifter answered, beside the keypoints `seen` (None: they were not recorded).

    Keypoints and answer belong together when their stamps do, row by row. What a lifter does not
    publish is NaN: the residual, and the rotation of all but the first object. Raises ValueError
    if the answers are of another model than one with the layout `target`.
    """
    for answer in answers:
        if answer.confidence.shape[1] != len(target):
            raise ValueError(
                f"the recorded points are {answer.confidence.shape[1]} an object; the model has "
                f"{len(target)} keypoints: name the model that lifted them"
            )
    seen = _unseen(answers, len(source)) if seen is None else seen
    m, p = len(seen), len(target)
    shapes, rotations = np.full((m, p, 3), np.nan, np.float32), np.full((m, 3, 3), np.nan)
    confidence = np.zeros((m, p), np.float32)
    for answer in answers:
        rows = _rows(seen, answer)
        shapes[rows], confidence[rows] = answer.shapes[: len(rows)], answer.confidence[: len(rows)]
        if len(rows) and answer.rotation is not None:
            rotations[rows[0]] = answer.rotation
    points, known = KeypointMap(source, target)(seen.points, seen.confidence)
    centred = centre(shapes)
    scale, translation = weak_perspective(points, centred[..., :2], known > 0)
    scale = np.where((known > 0).any(1), scale, np.nan).astype(np.float32)
    unknown = np.full(m, np.nan, np.float32)
    rotations = rotations.astype(np.float32)
    lifted = Lifted(shapes, rotations, scale, translation, unknown, confidence)
    return Recording(source, target, seen, lifted)


def _rows(seen: Detections, answer: LiftedMessage) -> NDArray[np.int64]:
    """Return the rows of `seen` that an answer is about, in its order."""
    if not len(seen.stamps):
        return np.empty(0, np.int64)
    frame = int(np.abs(seen.stamps - answer.stamp).argmin())
    if abs(int(seen.stamps[frame]) - answer.stamp) > _TOGETHER:
        return np.empty(0, np.int64)
    return np.flatnonzero(seen.frame == frame)[: len(answer.shapes)]


def _unseen(answers: Sequence[LiftedMessage], keypoints: int) -> Detections:
    """Return frames for answers of which nobody recorded the keypoints."""
    shown = [np.zeros((len(answer.shapes), keypoints), np.float32) for answer in answers]
    nothing = [Observation(np.zeros((*c.shape, 2), np.float32), c) for c in shown]
    return gather(nothing, [answer.stamp for answer in answers], keypoints)
