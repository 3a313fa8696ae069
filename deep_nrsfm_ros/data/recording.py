# SPDX-License-Identifier: Apache-2.0
"""Recordings: 2D keypoints as detected, and the 3D shapes lifted from them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.batched import slices
from deep_nrsfm_ros.data.detections import Detections, gather
from deep_nrsfm_ros.data.lifted_bags import LiftedMessage
from deep_nrsfm_ros.data.over_time import NONE, OverTime, is_in_time, lift_stream, stream_of
from deep_nrsfm_ros.large_arrays import release
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.history import Context
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter, lift_all
from deep_nrsfm_ros.lifting.observation import Observation
from deep_nrsfm_ros.lifting.perspective import lift_perspective
from deep_nrsfm_ros.lifting.track_matching import keypoint_tolerances
from deep_nrsfm_ros.model_files.matching_model import map_to_model
from deep_nrsfm_ros.nrsfm.geometry import Floats, centre, reprojection_error, weak_perspective

_CAUSAL = OverTime()

# From a fixed frame (x front, y left, z up) to the axes of a level camera that looks along its x.
_LEVEL_CAMERA = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]], np.float32)
_MAX_MISFIT = 0.5  # reprojection error; below 0.3 in the right axes, about 0.9 in others
_MAX_DELAY = 50_000_000  # ns between the stamps of keypoints and points of one frame


@dataclass(frozen=True)
class Recording:
    """The m objects of a recording.

    Attributes:
        source: layout of the detections.
        target: layout of the lifted shapes.
        detections: the 2D keypoints.
        lifted: the 3D shapes; NaN with confidence 0 for objects that were not lifted.
        fixed_frame: frame with z up in which a lifter with target_frame gave the shapes, which are
            here in the axes of a level camera that looks along its x. "" = in the camera's axes.
    """

    source: KeypointLayout
    target: KeypointLayout
    detections: Detections
    lifted: Lifted
    fixed_frame: str = ""

    @property
    def is_lifted(self) -> NDArray[np.bool_]:
        """Return which objects (m,) were lifted."""
        is_lifted = np.empty(len(self.lifted.shapes), bool)
        for rows in slices(len(is_lifted)):
            is_lifted[rows] = ~np.isnan(self.lifted.shapes[rows].sum((1, 2)))
            release(self.lifted)
        return is_lifted


def lift_recording(
    detections: Detections,
    source: KeypointLayout,
    lifter: Lifter,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    intrinsics: Intrinsics | None = None,
    over_time: OverTime = _CAUSAL,
) -> Recording:
    """Lift all objects of a recording.

    Frames that do not follow each other, as unrelated images, are lifted each by itself.

    Args:
        detections: 2D keypoints in pixels.
        source: their layout.
        lifter: model and options; its layout need not be `source`.
        on_progress: called with the number of objects done and their total number.
        intrinsics: of the camera, so that shapes are at their position in front of it; None =
            each shape is centred at the origin.
        over_time: how the frames help each other.

    Raises:
        ValueError: too few keypoints of the layout are keypoints of the model.
    """
    target = lifter.model.layout
    to_model = map_to_model(source, target)
    if lifter.layout != source:
        history = lifter.constants.history
        lifter = Lifter(lifter.model, lifter.options, layout=source, history=history)
    if over_time.smooth != NONE or over_time.up is not None:
        stream = stream_of(detections, to_model, keypoint_tolerances(target))
        if not is_in_time(stream):
            over_time = over_time._replace(smooth=NONE)
    if not len(detections) or (over_time.smooth == NONE and over_time.up is None):
        lift = partial(lift_perspective, lifter, intrinsics) if intrinsics else lifter.lift
        lifted = lift_all(
            lambda *keypoints: lift(*to_model(*keypoints)),
            detections.points,
            detections.confidence,
            on_progress,
        )
        return Recording(source, target, detections, lifted)

    def lift_frame(points: Floats, confidence: Floats, context: Context) -> Lifted:
        if intrinsics:
            return lift_perspective(lifter, intrinsics, points, confidence, context)
        return lifter.lift(points, confidence, context=context)

    lifted = lift_stream(lift_frame, lifter.memory(), stream, over_time, on_progress)
    return Recording(source, target, detections, lifted)


def join_lifted_messages(
    messages: Sequence[LiftedMessage],
    detections: Detections | None,
    source: KeypointLayout,
    target: KeypointLayout,
    fixed_frame: str = "",
) -> Recording:
    """Return recorded messages of a lifter, joined with the keypoints that they belong to.

    A message belongs to the frame with the nearest stamp, at most 50 ms away, and its rows to the
    objects of that frame. What a lifter does not publish is NaN: the residual, and the rotations
    of all objects but the first.

    Args:
        messages: lifted messages.
        detections: the recorded keypoints; None = they were not recorded.
        source: layout of the detections.
        target: layout of the model that lifted them.
        fixed_frame: known target_frame of the lifter; "" = the keypoints tell whether it has one.

    Raises:
        ValueError: the messages are of a model with another number of keypoints.
    """
    for message in messages:
        if message.confidence.shape[1] != len(target):
            raise ValueError(
                f"the recorded points are {message.confidence.shape[1]} an object; the model has "
                f"{len(target)} keypoints: name the model that lifted them"
            )
    if detections is None:
        detections = _empty_detections(messages, len(source))
    m, p = len(detections), len(target)
    shapes, rotations = np.full((m, p, 3), np.nan, np.float32), np.full((m, 3, 3), np.nan)
    confidence = np.zeros((m, p), np.float32)
    for message in messages:
        rows = _rows(detections, message)
        n = len(rows)
        shapes[rows], confidence[rows] = message.shapes[:n], message.confidence[:n]
        if n and message.rotation is not None:
            rotations[rows[0]] = message.rotation
    points, visible = KeypointMap(source, target)(detections.points, detections.confidence)
    scale, translation = weak_perspective(points, centre(shapes)[..., :2], visible > 0)
    scale = np.where((visible > 0).any(1), scale, np.nan).astype(np.float32)
    unknown = np.full(m, np.nan, np.float32)
    rotations = rotations.astype(np.float32)
    fixed_frame = fixed_frame or _fixed_frame(messages, detections.frame_id)
    if not (fixed_frame or detections.frame_id) and _has_z_up(points, visible > 0, shapes):
        fixed_frame = next((each.frame_id for each in messages if each.frame_id), "target_frame")
    if fixed_frame:
        shapes[...], rotations = shapes @ _LEVEL_CAMERA.T, _LEVEL_CAMERA @ rotations
        scale, translation = unknown, np.full((m, 2), np.nan, np.float32)
    nothing = np.zeros((m, p), np.bool_)  # a recording does not say what the lifter left out
    lifted = Lifted(shapes, rotations, scale, translation, unknown, confidence, nothing)
    return Recording(source, target, detections, lifted, fixed_frame)


def _fixed_frame(messages: Sequence[LiftedMessage], camera: str) -> str:
    """Return the one frame of all messages if it is not that of the camera; "" = it is, or unknown.

    A lifter without target_frame that lifts for several cameras gives points in several frames.
    """
    frames = {message.frame_id for message in messages}
    return frames.pop() if camera and len(frames) == 1 and camera not in frames else ""


def _has_z_up(points: Floats, visible: NDArray[np.bool_], shapes: Floats) -> bool:
    """Return whether shapes (m, p, 3) project to their keypoints (m, p, 2) with z up only."""
    known = np.isfinite(shapes).all((1, 2)) & (visible.sum(1) > 1)
    if not known.any():
        return False
    image, seen, S = points[known], visible[known], centre(shapes[known])
    axes = S, S @ _LEVEL_CAMERA.T
    as_is, turned = (np.median(reprojection_error(image, P[..., :2], seen)) for P in axes)
    return bool(turned < _MAX_MISFIT < as_is)


def _rows(detections: Detections, message: LiftedMessage) -> NDArray[np.int64]:
    """Return the indices of the detections that a message belongs to, in its order."""
    if not len(detections.stamps):
        return np.empty(0, np.int64)
    frame = int(np.abs(detections.stamps - message.stamp).argmin())
    if abs(int(detections.stamps[frame]) - message.stamp) > _MAX_DELAY:
        return np.empty(0, np.int64)
    return np.flatnonzero(detections.frame == frame)[: len(message.shapes)]


def _empty_detections(messages: Sequence[LiftedMessage], keypoints: int) -> Detections:
    """Return a frame for each message, with all keypoints missing."""
    confidences = [np.zeros((len(message.shapes), keypoints), np.float32) for message in messages]
    empty = [Observation(np.zeros((*c.shape, 2), np.float32), c) for c in confidences]
    return gather(empty, [message.stamp for message in messages], keypoints)
