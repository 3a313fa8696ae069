# SPDX-License-Identifier: Apache-2.0
"""Subscription to measured depth, which fixes place and size of lifted objects."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from deep_nrsfm_ros.body.depth import (
    AGREEMENT,
    MIN_KEYPOINTS,
    Agreement,
    DepthFit,
    DepthScale,
    RangeScale,
    believed_scales,
    surface_radii,
)
from deep_nrsfm_ros.configuration import described, option
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.lifting.observation import MessageError
from deep_nrsfm_ros.messages.depth_messages import read_depth_image, read_depth_points, read_range
from deep_nrsfm_ros.messages.pipeline import Pipeline
from deep_nrsfm_ros.messages.serialised import Header, read_stamp
from deep_nrsfm_ros.node.camera import Camera
from deep_nrsfm_ros.node.message_types import decoder, message_class

IMAGE, POINTS, RANGE = "image", "points", "range"
TYPES = {IMAGE: "sensor_msgs/Image", POINTS: "sensor_msgs/PointCloud2", RANGE: "sensor_msgs/Range"}
_STREAM = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
_KEPT = 2_000_000_000  # ns for which messages are kept for keypoints that come later
_KEPT_BYTES = 100_000_000
_MAX_SHOWN = 8  # objects in the diagnostics
_MAX_WARNINGS = 20  # different ones in the log
_LEAST_AGREEMENT = 0.4  # share of keypoints: 0.27 where unregistered, 0.46 to 0.75 else
_UNUSED = "is not used"
_ENOUGH = 50  # keypoints with depth in a period that may say so


@dataclass(frozen=True)
@described
class DepthOptions:
    """Measured depth."""

    topic: str = option(
        "",
        "topic of measured depth, seen by the keypoints' camera; it sets place and size of an "
        "object in metres, so that most confident keypoints have the measured depth; without depth "
        "at a message, an object keeps the size that its identity has had; needs camera_info or "
        "field_of_view; empty = no depth",
        read_only=True,
    )
    type_: str = option(
        IMAGE,
        "type of depth.topic: image = sensor_msgs/Image, 16UC1 in mm or 32FC1 in m, registered to "
        "the image of the keypoints and of the same size; points = sensor_msgs/PointCloud2 in the "
        "camera's optical frame; range = sensor_msgs/Range, one distance along the optical axis",
        choices=tuple(TYPES),
        read_only=True,
    )
    tolerance: float = option(
        0.05,
        "largest difference in s of the stamps of keypoints and depth; the nearest one is taken; "
        "0.05 typical, 0.2 for slow people or slow sensors",
        low=0.0,
        high=10.0,
        read_only=True,
    )
    agreement: float = option(
        AGREEMENT,
        "difference in metres up to which a keypoint's measured and lifted depth agree; a keypoint "
        "with something nearer in front of it counts as occluded; 0.2 typical of people",
        low=0.001,
        high=10.0,
        read_only=True,
    )
    min_keypoints: int = option(
        MIN_KEYPOINTS,
        "fewest keypoints of an object that must agree with its measured depth, else the depth is "
        "not used; of image and points; 3 typical",
        low=1,
        high=1000,
        read_only=True,
    )


class _Result(NamedTuple):
    """What the depth of one message has said of its objects."""

    identities: Sequence[str]
    layout: KeypointLayout
    scales: NDArray[Any]
    fit: DepthFit | None  # None: a range
    met: int = -1  # object that a range has met


class DepthSubscription:
    """Keeps depth messages for a short time, and scales lifted objects with the matching one.

    Attributes:
        problem: why no keypoints of the last period had depth, or why it cannot be believed;
            "" if neither.
    """

    def __init__(self, node: Node, options: DepthOptions, camera: Camera) -> None:
        """Subscribe.

        Raises:
            ValueError: there is no camera.
        """
        if not camera.enabled:
            raise ValueError(
                f"depth.topic is {options.topic!r} without camera_info or field_of_view: depth is "
                "compared with objects at their places; set camera_info to the topic of the "
                "CameraInfo"
            )
        self._node, self._options, self._camera = node, options, camera
        kind = TYPES[options.type_]
        self._decode = decoder(kind)
        self._messages: deque[tuple[int, bytes]] = deque()
        self._bytes = 0
        self._decoded: tuple[bytes, Any] | None = None
        self._scales: DepthScale | RangeScale | None = None
        self._scaled: tuple[KeypointLayout, float] | None = None
        self._result: _Result | None = None
        self._warned: set[str] = set()
        self.problem = self._reason = ""
        self._matched = self._asked = self._agree = self._measured = 0
        self._topic = node.create_subscription(
            message_class(kind),
            options.topic,
            self._receive,
            _STREAM,
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
        ).topic_name

    def __call__(
        self,
        header: Header,
        lifted: Lifted,
        identities: Sequence[str],
        seconds: float,
        pipeline: Pipeline,
    ) -> tuple[Lifted, NDArray[np.bool_]]:
        """Return objects with the place and size that the depth says; a failure changes nothing.

        Args:
            header: of the keypoints.
            lifted: n objects at their places.
            identities: n, unique over all topics; "" has no memory.
            seconds: time of the keypoints.
            pipeline: has lifted them.

        Returns:
            The objects, and which of them (n,) have a scale from depth, now or remembered.
        """
        self._asked += 1
        depth = self._depth_at(header)
        layout, length = pipeline.model.layout, pipeline.reference_length
        if self._scales is None or self._scaled != (layout, length):
            self._scales, self._scaled = self._new_scales(layout, length), (layout, length)
        shapes = lifted.shapes
        if isinstance(self._scales, RangeScale):
            distance, half_angle = depth or (np.nan, 0.0)
            scales, met = self._scales(identities, shapes, distance, half_angle, seconds)
            self._result = _Result(identities, layout, scales, None, met)
        else:
            measured = self._depth_of(depth, shapes)
            scales, fit = self._scales(identities, shapes, lifted.confidence, measured, seconds)
            self._result = _Result(identities, layout, scales, fit)
            self._agree += int(fit.agree.sum())
            self._measured += int(fit.measured.sum())
        self._matched += depth is not None
        placed = np.isfinite(scales)
        s = np.where(placed, scales, 1).astype(np.float32)
        lifted = lifted._replace(shapes=s[:, None, None] * shapes, scale=lifted.scale / s)
        return lifted, placed

    def forget(self) -> None:
        """Forget all identities."""
        self._scales = self._result = None

    def report(self) -> dict[str, str]:
        """Return the state of the period since the last report, for diagnostics."""
        reason = self._reason_for_doubt()
        self.problem = reason if self._matched or not self._asked else self._reason
        text = f"{self._matched} of {self._asked} messages with depth"
        if self._reason and self._matched < self._asked:
            text += f": {self._reason}"
        if self.problem:
            self._warn(self.problem, "is in doubt" if reason else _UNUSED)
        self._matched = self._asked = self._agree = self._measured = 0
        values = {"depth": text}
        if self._result is not None:
            for i, identity in enumerate(self._result.identities[:_MAX_SHOWN]):
                values[f"depth of {identity or i}"] = _describe(self._result, i)
        return values

    def _reason_for_doubt(self) -> str:
        """Return why the depth of the period cannot be believed; "" if it can."""
        if self._measured < _ENOUGH or self._agree >= _LEAST_AGREEMENT * self._measured:
            return ""
        return (
            f"only {100 * self._agree / self._measured:.0f} % of the keypoints have the depth on "
            f"{self._topic} with which they are lifted, more than half are usual: is it registered "
            "to the camera of the keypoints?"
        )

    def _receive(self, raw: bytes) -> None:
        """Keep a serialised message."""
        try:
            stamp = read_stamp(raw)
        except MessageError as problem:
            self._warn(f"message on {self._topic} has {problem}")
            return
        if self._messages and abs(stamp - self._messages[-1][0]) > _KEPT:
            self._messages.clear()  # the stamps begin anew, or jump
            self._bytes = 0
        self._messages.append((stamp, raw))
        self._bytes += len(raw)
        while len(self._messages) > 1 and (
            self._bytes > _KEPT_BYTES or stamp - self._messages[0][0] > _KEPT
        ):
            self._bytes -= len(self._messages.popleft()[1])

    def _depth_at(self, header: Header) -> Any:
        """Return the depth of the message nearest to a header's stamp; None: there is none."""
        raw = self._nearest(header.stamp)
        if raw is None:
            return None
        if self._decoded is None or self._decoded[0] is not raw:
            try:
                self._decoded = raw, self._read(raw, header.frame_id)
            except Exception as problem:  # a bad message of depth must not stop the keypoints
                self._decoded = raw, None
                self._reason = str(problem) if isinstance(problem, ValueError) else repr(problem)
                self._warn(self._reason)
        return self._decoded[1]

    def _nearest(self, stamp: int) -> bytes | None:
        """Return the message nearest to a stamp in ns; None: none is within the tolerance."""
        if not self._messages:
            self._reason = self._why_silent()
            return None
        own, raw = min(self._messages, key=lambda kept: abs(kept[0] - stamp))
        apart = 1e-9 * (own - stamp)
        if abs(apart) <= self._options.tolerance:
            return raw
        self._reason = (
            f"the nearest depth on {self._topic} is {abs(apart):.3f} s "
            f"{'after' if apart > 0 else 'before'} the keypoints; depth.tolerance is "
            f"{self._options.tolerance:g}"
        )
        return None

    def _read(self, raw: bytes, frame: str) -> Any:
        """Return the depth of a serialised message; raise MessageError if it cannot be used."""
        message = self._decode(raw)
        if self._options.type_ == RANGE:
            return read_range(message)
        own = message.header.frame_id
        if own and frame and own != frame:
            raise MessageError(
                f"depth on {self._topic} is in frame {own!r} and the keypoints are in {frame!r}: "
                "name the topic of the depth that is registered to the camera of the keypoints"
            )
        intrinsics = self._camera.require_intrinsics()
        assert intrinsics
        if self._options.type_ == IMAGE:
            return read_depth_image(message, self._camera.size)
        return read_depth_points(message, self._camera.size, intrinsics)

    def _depth_of(self, depth: Any, shapes: NDArray[np.float32]) -> NDArray[Any]:
        """Return the depth (n, p) at the pixels of lifted points, NaN if there is none."""
        intrinsics = self._camera.intrinsics
        if depth is None or intrinsics is None:
            return np.full(shapes.shape[:2], np.nan)
        with np.errstate(invalid="ignore", divide="ignore"):
            pixels = intrinsics.pixels(shapes[..., :2] / shapes[..., 2:])
        measured: NDArray[Any] = depth.at(pixels)
        return measured

    def _new_scales(self, layout: KeypointLayout, length: float) -> DepthScale | RangeScale:
        """Return an empty memory of scales for a layout."""
        radii, scales = surface_radii(layout, length), believed_scales(layout, length)
        if self._options.type_ == RANGE:
            return RangeScale(radii, [(a, b) for a, b in layout.edge_indices()], scales)
        agreement = Agreement(self._options.agreement, self._options.min_keypoints, scales)
        return DepthScale(radii, agreement)

    def _why_silent(self) -> str:
        """Return why no depth has been received, from the topics that there are."""
        infos = self._node.get_publishers_info_by_topic(self._topic)
        kinds = sorted({info.topic_type.replace("/msg/", "/") for info in infos})
        expected = TYPES[self._options.type_]
        start = f"no depth on {self._topic}: "
        if not kinds:
            return start + "nobody publishes it"
        if expected not in kinds:
            return start + (
                f"the topic carries {', '.join(kinds)}; depth.type {self._options.type_} is "
                f"{expected}"
            )
        return start + "it has a publisher, which has sent nothing yet"

    def _warn(self, problem: str, state: str = _UNUSED) -> None:
        """Log a problem of the depth and what comes of it, if its kind is new."""
        kind = "".join(c for c in problem if not c.isdigit())
        if kind not in self._warned and len(self._warned) < _MAX_WARNINGS:
            self._warned.add(kind)
            self._node.get_logger().warning(f"depth {state}: {problem}")


def _describe(result: _Result, i: int) -> str:
    """Return what the depth says of object i, as text."""
    scale = f"scale {result.scales[i]:.2f}"
    remembered = "not scaled" if np.isnan(result.scales[i]) else f"{scale} as before"
    fit = result.fit
    if fit is None:
        return f"{scale} by the range" if i == result.met else f"not in the beam, {remembered}"
    if np.isnan(fit.scales[i]):
        return f"{fit.measured[i]} confident keypoints with depth, too few agree, {remembered}"
    names = np.array(result.layout.keypoints)
    text = f"{fit.agree[i].sum()} of {fit.measured[i]} confident keypoints agree, {scale}"
    for word, which in (("occluded", fit.occluded[i]), ("beside the body", fit.beside[i])):
        if which.any():
            text += f"; {word}: {', '.join(names[which])}"
    return text
