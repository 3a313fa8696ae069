# SPDX-License-Identifier: Apache-2.0
"""The node `lifter`: 2D keypoints in, 3D points and the camera's rotation out.

For every message on `keypoints` the node publishes, with the header of that message,

- ~/points: n objects (rows) of p keypoints (columns): x right, y down, z forward, and confidence.
  Positions in the camera's optical frame if its CameraInfo or its field of view is known, else
  centred on the keypoints of each object; the layout's reference pair has the length of the
  parameter reference_length; NaN where an object is not lifted.
- ~/camera_rotation: from the axes of the first object to those of the camera, or of target_frame;
  not published if the first object is not lifted. The axes are x front, y left, z up if the layout
  has a handedness.
- ~/objects: identity of the object in each row, and its transform; only with a subscriber.
- ~/markers: shapes for RViz; only with a subscriber.
- ~/skeleton: names of keypoints and joints, latched; ~/joints, ~/joint_states, ~/tracks: frames,
  angles and states of tracking; only with a subscriber. See `node/bodies.py` for more of them.
- ~/detections_3d: the detections of yolo_ros with 3D keypoints; with CameraInfo and a subscriber.
- /tf: a frame for each object; only with the parameter tf_prefix.

With the parameter managed, it is a managed node (lifecycle); see `node/lifecycle.py`.

The node does not import torch: lifting needs NumPy only, and training is a process of its own.
"""

from __future__ import annotations

import math
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import QuaternionStamped
from numpy.typing import NDArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from visualization_msgs.msg import MarkerArray

from deep_nrsfm_ros.body.depth import believed_scales
from deep_nrsfm_ros.body.floor import FloorScale, floor_factor
from deep_nrsfm_ros.configuration import described, option
from deep_nrsfm_ros.data.curation import Curation
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap, TooFewSharedError
from deep_nrsfm_ros.layouts.layout import TRUNK, KeypointLayout
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.lifting.observation import Observation
from deep_nrsfm_ros.lifting.options import (
    FieldOfViewOptions,
    GravityOptions,
    HistoryOptions,
    LiftingOptions,
)
from deep_nrsfm_ros.lifting.sanity import POOR_RESIDUAL, Finding, is_person
from deep_nrsfm_ros.lifting.smoothing import SmoothingOptions
from deep_nrsfm_ros.messages.detections_3d import Lifted3D
from deep_nrsfm_ros.messages.field_mapping import YOLO
from deep_nrsfm_ros.messages.mapping_file import MAPPING_SUFFIXES
from deep_nrsfm_ros.messages.options import AUTO, MODEL_ORDER, InputOptions
from deep_nrsfm_ros.messages.pipeline import Pipeline
from deep_nrsfm_ros.messages.scene_check import FloorCheck, GravityCheck, WrongKeypointCheck
from deep_nrsfm_ros.messages.serialised import Header
from deep_nrsfm_ros.messages.stamps import Moment
from deep_nrsfm_ros.messages.stream_check import Choice, StreamCheck
from deep_nrsfm_ros.messages.unused_options import (
    unused_depth,
    unused_gravity,
    unused_height,
    unused_options,
)
from deep_nrsfm_ros.model_files.find_layout import find_layout
from deep_nrsfm_ros.model_files.model_file import Model, load_model
from deep_nrsfm_ros.model_files.path_sandbox import PathSandbox
from deep_nrsfm_ros.node import parameter_bridge, publishing
from deep_nrsfm_ros.node.bodies import BodyOptions, BodyPublishers, Scene
from deep_nrsfm_ros.node.camera import Camera, CameraOptions
from deep_nrsfm_ros.node.depth import DepthOptions, DepthSubscription
from deep_nrsfm_ros.node.detections_3d import DetectionsPublisher
from deep_nrsfm_ros.node.diagnostics import ERROR, OK, WARN, LifterDiagnostics, status
from deep_nrsfm_ros.node.entities import Entities
from deep_nrsfm_ros.node.gravity import Gravity, GravityDirection, GravitySources
from deep_nrsfm_ros.node.shutdown import shut_down
from deep_nrsfm_ros.node.subscriptions import LOG_PERIOD, KeypointSubscriptions, KeypointTopic
from deep_nrsfm_ros.node.surroundings import NameCheck, launch_has_ended
from deep_nrsfm_ros.node.target_frame import TargetFrame, TargetOptions
from deep_nrsfm_ros.node.training_service import TrainingService
from deep_nrsfm_ros.node.transforms import TransformBroadcaster
from deep_nrsfm_ros.nrsfm.recipe import LayoutLossWeights, Recipe
from deep_nrsfm_ros.training.limits import Limits
from deep_nrsfm_ros.training.request import (
    LifterInput,
    TrainingOptions,
    TrainingParameters,
    TrainingRequest,
    paths_of,
    training_request,
)

if TYPE_CHECKING:
    from deep_nrsfm_ros.node.lifecycle import Lifecycle

_SMOOTHING = "smoothing."
_HISTORY = "history."
_GRAVITY = "gravity."
_DEPTH = "depth."
_BODY = "body."
_TRAIN = "train."
_REPORT_PERIOD = 1.0  # seconds
_LOST_PERIOD = 0.5  # seconds between two looks for topics that have fallen silent
_FRAME_LOG_PERIOD = 60.0  # seconds
_EARLY_CHECKS = 5  # reports at the start in each of which the input is looked at
_CHECK_EVERY = 10  # reports between two looks at an input in which nothing looked wrong
_PRESENT = 3.0  # seconds for which the objects of a topic's last message count as present
_FINDING_PERIOD = 30.0  # seconds between two log entries of the same finding
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_TRAINING_GRACE = 1.0  # seconds in which a training may save its model when the node ends


@dataclass(frozen=True)
@described
class NodeOptions:
    """Node."""

    managed: bool = option(
        False,
        "whether the node is a managed one (lifecycle): it does nothing before the transitions "
        "configure (loads the model, creates the topics) and activate (receives keypoints), which "
        "a launch file, nav2's lifecycle manager or `ros2 lifecycle set` asks for; needs "
        "lifecycle_msgs",
        read_only=True,
    )


class Stage(Enum):
    """How far the node is; the values are the names of the lifecycle's states."""

    UNCONFIGURED = "unconfigured"
    INACTIVE = "inactive"
    ACTIVE = "active"


class LifterNode(Node):
    """Lifts every message on `keypoints` with the model that the parameters name.

    A node that is not managed is configured and activated at its start.
    """

    def __init__(self) -> None:
        """Declare the parameters; configure and activate the node unless it is managed.

        Raises:
            ValueError: a parameter or the model is not usable.
            ParameterException: rclpy refuses the value of a parameter.
        """
        super().__init__("lifter")
        managed = parameter_bridge.declare(self, NodeOptions).managed
        inputs = parameter_bridge.declare(self, InputOptions)
        parameter_bridge.declare(self, LiftingOptions)
        self._camera_options = parameter_bridge.declare(self, CameraOptions)
        self._view = parameter_bridge.declare(self, FieldOfViewOptions)
        self._target_options = parameter_bridge.declare(self, TargetOptions)
        parameter_bridge.declare(self, HistoryOptions, _HISTORY)
        parameter_bridge.declare(self, SmoothingOptions, _SMOOTHING)
        parameter_bridge.declare(self, GravityOptions, _GRAVITY)
        self._gravity_sources = parameter_bridge.declare(self, GravitySources, _GRAVITY)
        self._depth_options = parameter_bridge.declare(self, DepthOptions, _DEPTH)
        self._body_options = parameter_bridge.declare(self, BodyOptions, _BODY)
        training = parameter_bridge.declare(self, TrainingOptions, _TRAIN)
        parameter_bridge.declare(self, Recipe, _TRAIN)
        parameter_bridge.declare(self, LayoutLossWeights, _TRAIN)
        parameter_bridge.declare(self, Limits, _TRAIN)
        parameter_bridge.declare(self, Curation, _TRAIN)
        self._sandbox = PathSandbox(
            Path(inputs.models_dir).expanduser(),
            Path(inputs.bags_dir).expanduser(),
            (inputs.model, inputs.keypoint_layout, *paths_of(training)),
        )
        self._stage = Stage.UNCONFIGURED
        self._lifecycle = self._manage() if managed else None
        if not managed:
            self.configure()
        self._diagnostics_publisher = self._quiet_publisher(DiagnosticArray, "/diagnostics")
        # A steady clock: in ROS time, a paused simulation would stop the reports.
        self.create_timer(
            _REPORT_PERIOD, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        self.add_on_set_parameters_callback(self._validate_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        if not managed:
            self.activate()
        self._name_check = NameCheck(self)

    def _manage(self) -> Lifecycle:
        """Return the state machine of a managed node; raise ValueError if its package is missing.

        It is imported here because only a managed node needs it.
        """
        try:
            from deep_nrsfm_ros.node.lifecycle import Lifecycle
        except ImportError as error:
            raise ValueError(
                f"managed is true, and rclpy's lifecycle or lifecycle_msgs is missing ({error}): "
                "install it (apt install ros-jazzy-lifecycle-msgs), or set managed to false"
            ) from None
        return Lifecycle(self, self, _error_text)

    def configure(self) -> None:
        """Load the model and create everything but the input.

        Raises:
            ValueError: a parameter or the model is not usable; nothing has been created.
        """
        self._entities = Entities(self)
        try:
            self._configure()
        except Exception:
            self._entities.destroy()
            raise
        self._stage = Stage.INACTIVE

    def _configure(self) -> None:
        """Do what `configure` does, up to the error."""
        camera = self._camera_options
        self._inputs = parameter_bridge.read(self, InputOptions)
        self._up = parameter_bridge.read(self, GravityOptions, _GRAVITY).direction
        self._auto = self._inputs.keypoint_layout == AUTO
        self._chosen: Choice | None = None
        self._pipeline = self._proposed = self._build_pipeline(())
        self._stream = StreamCheck(search=self._auto)
        self._findings: list[Finding] = []
        self._logged: dict[str, float] = {}
        self._checks = 0
        self._unused: frozenset[str] = frozenset()

        self._frame_id, self._last_frame = camera.frame_id, ""
        self._camera = Camera(self, camera, self._view, self._pipeline.image_size)
        self._gravity = GravityDirection(self, self._gravity_sources)
        self._gravity_check, self._gravity_source = GravityCheck(), ""
        self._floor_check, self._wrong_check = FloorCheck(), WrongKeypointCheck()
        self._scenes: dict[str, tuple[float, Scene]] = {}  # the last of each topic, and when
        self._floor_sizes: tuple[Sequence[str], NDArray[np.float32]] = ((), np.ones(0, np.float32))
        depth = self._depth_options
        self._depth = DepthSubscription(self, depth, self._camera) if depth.topic else None
        self._floor = FloorScale(camera.camera_height) if camera.camera_height else None
        self._target = TargetFrame(self, self._target_options, positioned=self._camera.enabled)
        self._tf = TransformBroadcaster(self, camera.tf_prefix) if camera.tf_prefix else None
        self._points = self._quiet_publisher(PointCloud2, "~/points")
        self._rotation = self._quiet_publisher(QuaternionStamped, "~/camera_rotation")
        self._objects = self._quiet_publisher(MultiDOFJointState, "~/objects")
        self._markers = self._quiet_publisher(MarkerArray, "~/markers")
        self._detections: DetectionsPublisher | None = None
        self._bodies = BodyPublishers(self, self._body_options, camera.tf_prefix)
        self._bodies.describe(self._pipeline.model.layout)
        self.create_timer(
            _LOST_PERIOD, self._tell_lost, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        self._training = TrainingService(
            self,
            self._training_request,
            self._switch_model,
            lambda: self._pipeline.model,
            lambda: self._pipeline.source,
            self._sandbox.models_dir,
        )

    def activate(self) -> None:
        """Subscribe to the keypoints, with nothing remembered of any object.

        Raises:
            ValueError: a parameter of the input is not usable; there is no subscription.
        """
        self._lifter_diagnostics = LifterDiagnostics()
        self.get_logger().info(
            f"lifting with model {self._pipeline.model.name!r}: "
            + (
                "keypoints in a layout that the first messages show (keypoint_layout: auto)"
                if self._stream.searching
                else f"{len(self._pipeline.source)} keypoints in the order of "
                f"{self._pipeline.source.name!r}"
            )
        )
        self._log_unit()
        self._log_field_of_view()
        if self._pipeline.remembers:
            self.get_logger().info(
                "an answer depends on the last seconds of its object too; -p "
                "history.enabled:=false lifts each message by itself"
            )
        self._keypoint_topics = KeypointSubscriptions(
            self,
            self._inputs,
            on_message=self._lift,
            on_problem=self._lifter_diagnostics.publisher_problem,
            on_dropped=self._lifter_diagnostics.dropped,
        )
        for warning in (*parameter_bridge.undeclared(self), *self._unused_options()):
            self.get_logger().warning(warning)
        self._stage = Stage.ACTIVE

    def deactivate(self) -> None:
        """Unsubscribe from the keypoints and forget all objects; the model stays loaded."""
        self._keypoint_topics.close()
        self._pipeline.forget()
        self._bodies.forget()
        self._forget_scene()
        if self._floor:
            self._floor.forget()
        if self._depth is not None:
            self._depth.forget()
        self._stage = Stage.INACTIVE

    def _forget_scene(self) -> None:
        """Forget the last objects, by which gravity and the camera's height are checked too."""
        self._scenes.clear()
        self._gravity_check.forget()
        self._floor_check.forget()
        self._wrong_check.forget()

    def clean_up(self) -> None:
        """Release the model, the topics and the services, and end a running training."""
        self._training.close(_TRAINING_GRACE)
        self._entities.destroy()
        del self._pipeline, self._proposed, self._stream, self._bodies
        self._stage = Stage.UNCONFIGURED

    def _log_unit(self) -> None:
        """Log the unit of the output, if it is the layout's own."""
        layout = self._pipeline.model.layout
        lifting = parameter_bridge.read(self, LiftingOptions)
        own = layout.reference_length and lifting.length_for(layout) == layout.reference_length
        if own and not lifting.reference_length and layout.reference:
            a, b = layout.reference
            self.get_logger().info(
                f"metres: {a} to {b} is taken to be {layout.reference_length:g} m; -p "
                "reference_length, or -p person_height of people, says otherwise"
            )

    def _log_field_of_view(self) -> None:
        """Log that people are lifted more accurately with a camera, if there is none."""
        if not self._camera.enabled and is_person(self._pipeline.model.layout):
            self.get_logger().info(
                "hint: people are lifted more accurately, at their places in metres from the "
                "camera, with -p camera_info, or roughly with -p field_of_view (65 typical of "
                "webcams), image_width and image_height, the size of the image in which the "
                "keypoints were detected"
            )

    def _quiet_publisher(self, kind: type, topic: str) -> Publisher:
        """Return a publisher without event callbacks."""
        return self.create_publisher(kind, topic, 10, event_callbacks=publishing.NO_EVENT_CALLBACKS)

    def close(self) -> None:
        """End a running training."""
        if self._stage is not Stage.UNCONFIGURED:
            self._training.close(_TRAINING_GRACE)

    def _lift(self, source: KeypointTopic, raw: bytes) -> None:
        """Lift one serialised message and publish the result; this is the hot path."""
        started = time.perf_counter()
        self._stream.received(source.topic, source.reader, raw)
        if self._stream.searching:
            self._search_layout()
        try:
            # Asked once: objects have identities only if there was a subscriber before the lift.
            with_objects = self._objects.get_subscription_count() > 0
            scene, places = self._lifted_scene(source, raw, with_objects=with_objects)
        except Exception as problem:  # one bad message must not end the node
            if self.context.ok():  # else a signal came meanwhile, and the message is not at fault
                self._reject(source, problem)
            return
        self._scenes[source.topic] = time.monotonic(), scene
        if not scene.identities:
            self._lifter_diagnostics.empty()
            self._publish_bodies(source, scene)
            return
        self._publish_points(scene, with_objects=with_objects)
        if self._camera.enabled and source.reader.input_type == YOLO.type:
            self._publish_detections(scene.header, scene.lifted, raw, places)
        self._publish_bodies(source, scene)
        self._lifter_diagnostics.lifted(
            time.perf_counter() - started, scene.lifted.residual, scene.lifted.confidence
        )

    def _lifted_scene(
        self, source: KeypointTopic, raw: bytes, *, with_objects: bool
    ) -> tuple[Scene, tuple[int, ...]]:
        """Return the lifted objects of a message, and their `Observation.places`.

        Args:
            source: topic of the message.
            raw: the message, serialised.
            with_objects: whether ~/objects has a subscriber, which needs identities.

        Raises:
            MessageError: the message cannot be lifted.
        """
        intrinsics = self._camera.require_intrinsics()
        header, observation = self._pipeline.read(raw, source.reader, self._camera.size)
        moment = self._moment(source, header.stamp if header else 0)
        identities = self._identities(source, observation, moment, with_objects=with_objects)
        header = self._in_frame(source, header or self._now())
        up = self._against_gravity(header).up
        detected = len(identities)
        lifted, identities = self._pipeline.lift(
            observation, intrinsics, identities, source.topic, moment, up
        )
        if up is not None and is_person(self._pipeline.model.layout):
            self._gravity_check.add(time.monotonic(), lifted.rotations, up)
        self._wrong_check.add(time.monotonic(), lifted.wrong, lifted.residual)
        scene = Scene(header, lifted, identities, detected, moment)
        if identities:
            self._stream.lifted(lifted)  # in the camera's axes, before `target_frame`
        return self._placed(source, scene, up) if identities else scene, observation.places

    def _against_gravity(self, header: Header) -> Gravity:
        """Return the direction against gravity in the camera's axes, and its source."""
        found = self._gravity.find(self._up, header.frame_id, header.stamp)
        if found.up is None and self._target.name:
            return self._target.gravity(header)
        return found

    def _identities(
        self, source: KeypointTopic, observation: Observation, moment: Moment, *, with_objects: bool
    ) -> tuple[str, ...]:
        """Return the identity of each object of a message, or "" where nothing needs them."""
        needed = with_objects or self._tf or self._depth or self._bodies.wanted
        if needed or self._pipeline.needs_identities:
            return source.tracker(
                observation, moment.seconds, moment.period, self._pipeline.tolerances
            )
        return ("",) * len(observation.confidence)

    def _in_frame(self, source: KeypointTopic, header: Header) -> Header:
        """Return the header with the frame of the points."""
        if not header.frame_id or (self._frame_id and header.frame_id != self._frame_id):
            header = header._replace(frame_id=self._frame(source, header.frame_id))
        self._last_frame = header.frame_id
        return header

    def _placed(self, source: KeypointTopic, scene: Scene, up: NDArray[np.float64] | None) -> Scene:
        """Return objects at the place and size that depth or the floor gives, in `target_frame`."""
        if not (self._depth or self._floor or self._target.name):
            return scene
        header, lifted, identities, _, moment = scene
        names = _names_of(source.topic, identities) if self._depth or self._floor else []
        placed = None
        if self._depth is not None:
            lifted, placed = self._depth(header, lifted, names, moment.seconds, self._pipeline)
        if self._floor and up is not None:
            lifted = self._on_floor(names, lifted, up, moment, placed)
        if self._target.name:
            header, lifted = self._target(header, lifted)
        return scene._replace(header=header, lifted=lifted)

    def _publish_points(self, scene: Scene, *, with_objects: bool) -> None:
        """Publish points, rotation, objects, transforms and markers of at least one object."""
        header, lifted, identities, _, moment = scene
        positioned = self._camera.enabled
        self._points.publish(publishing.point_cloud(header, lifted))
        if not math.isnan(lifted.residual[0]):
            self._rotation.publish(publishing.camera_rotation(header, lifted.rotations[0]))
        if with_objects:
            self._objects.publish(
                publishing.objects(header, lifted, identities, positioned=positioned)
            )
        if self._tf:
            self._tf.send(header, lifted, identities)
        if self._markers.get_subscription_count():
            self._markers.publish(
                publishing.markers(
                    header, lifted, self._pipeline.edges, moment, positioned=positioned
                )
            )

    def _on_floor(
        self,
        names: Sequence[str],
        lifted: Lifted,
        up: NDArray[np.float64],
        moment: Moment,
        placed: NDArray[np.bool_] | None,
    ) -> Lifted:
        """Return objects at the size with which they stand on the floor; `placed` ones stay."""
        assert self._floor
        layout = self._pipeline.model.layout
        believed = believed_scales(layout, self._pipeline.reference_length)
        if self._floor_check.is_due(now := time.monotonic()):
            height = self._camera_options.camera_height
            factors = floor_factor(lifted.shapes.astype(np.float64), up, height)
            if placed is not None:
                factors[placed] = np.nan
            self._floor_check.add(now, factors, believed)
        scales = self._floor(names, lifted.shapes, up, moment.seconds, believed).astype(np.float32)
        if placed is not None:
            scales[placed] = 1
        self._floor_sizes = names, scales
        return lifted._replace(
            shapes=scales[:, None, None] * lifted.shapes, scale=lifted.scale / scales
        )

    def _publish_detections(
        self, header: Header, lifted: Lifted, raw: bytes, places: Sequence[int]
    ) -> None:
        """Publish the detections of yolo_ros in 3D for a subscriber; a failure ends no node."""
        try:
            if self._detections is None:
                self._detections = DetectionsPublisher(self)
            if self._detections.has_subscriber():
                shared = self._pipeline.shared_keypoints
                self._detections.publish(raw, Lifted3D(header.frame_id, lifted, places, shared))
        except Exception as problem:
            self.get_logger().warning(
                f"~/detections_3d not published: {_error_text(problem)}",
                throttle_duration_sec=LOG_PERIOD,
            )

    def _publish_bodies(self, source: KeypointTopic, scene: Scene) -> None:
        """Publish what is asked of the joints; a failure must not end the node."""
        if not self._bodies.has_subscriber():
            return
        try:
            self._bodies.publish(source.topic, scene, positioned=self._camera.enabled)
        except Exception as problem:
            self.get_logger().warning(
                f"joints of {source.topic} not published: {_error_text(problem)}",
                throttle_duration_sec=LOG_PERIOD,
            )

    def _tell_lost(self) -> None:
        """Publish who is lost on silent topics; a failure must not end the node."""
        try:
            self._bodies.tell_lost()
        except Exception as problem:
            self.get_logger().warning(
                f"lost objects not published: {_error_text(problem)}",
                throttle_duration_sec=LOG_PERIOD,
            )

    def _search_layout(self) -> None:
        """Choose the layout of the keypoints from the first messages; see `StreamCheck.search`."""
        try:
            choice = self._stream.search(self._pipeline, self._camera.size)
        except Exception as problem:  # a bad message must not end the node
            self.get_logger().warning(f"keypoint_layout: auto failed: {_error_text(problem)}")
            return
        if choice:
            self._set_layout(choice)

    def _set_layout(self, choice: Choice) -> None:
        """Lift with a layout that was chosen, and log it."""
        if self._chosen and self._chosen.layout.keypoints == choice.layout.keypoints:
            return
        self._chosen = choice
        own = choice.layout.keypoints == self._pipeline.model.layout.keypoints
        self._pipeline = self._proposed = self._assemble(
            self._pipeline.model, None if own else choice.layout
        )
        self.get_logger().info(
            f"keypoint_layout auto: {choice.layout.name} ({choice.reason}); "
            f"-p keypoint_layout:={choice.value} sets it for good"
        )

    def _moment(self, source: KeypointTopic, stamp: int) -> Moment:
        """Return the time of a message on its topic; begin anew where its stamps do."""
        warned = source.clock.warning
        moment = source.clock(stamp, time.monotonic_ns())
        if moment.restarted:
            source.tracker.restart()
            self._pipeline.restart(source.topic)
            self.get_logger().info(f"stamps on {source.topic} begin anew: so do identities")
        if source.clock.warning != warned:
            self.get_logger().warning(f"{source.topic}: {source.clock.warning}")
        return moment

    def _reject(self, source: KeypointTopic, problem: Exception) -> None:
        """Count a message that could not be lifted, and log the reason, throttled."""
        reason = _error_text(problem)
        self._lifter_diagnostics.rejected(reason)
        self.get_logger().warning(
            f"message on {source.topic} rejected: {reason}", throttle_duration_sec=LOG_PERIOD
        )

    def _frame(self, source: KeypointTopic, frame: str) -> str:
        """Return the frame of the points of a message in `frame`; warn if they have none."""
        diagnostics, problem = self._lifter_diagnostics, ""
        if frame:
            if not self._frame_id:
                return frame
            problem = (
                f"frame_id is {self._frame_id!r} and is not used: the header of the keypoints on "
                f"{source.topic} says {frame!r}; leave frame_id empty, or change the detector"
            )
        elif not (frame := self._frame_id or self._camera.frame):
            problem = (
                f"keypoints on {source.topic} have no frame_id, so neither have points and "
                "markers: set frame_id to the camera's optical frame"
            )
        if problem and not diagnostics.frame_problem:  # a log entry costs more than a lift
            diagnostics.frame_problem = problem
            self.get_logger().warning(problem, throttle_duration_sec=_FRAME_LOG_PERIOD)
        return frame

    def _now(self) -> Header:
        """Return the header of input without one: the present time and no frame."""
        return Header(*self.get_clock().now().seconds_nanoseconds())

    def _report(self) -> None:
        """Publish diagnostics; end with the launch."""
        if launch_has_ended():
            self.get_logger().warning("the launch that started this node has ended, so it ends too")
            rclpy.try_shutdown(context=self.context)
            return
        if warning := self._name_check():
            self.get_logger().warning(warning)
        is_active = self._stage is Stage.ACTIVE
        if self._stage is not Stage.UNCONFIGURED:
            self._camera.update()
        statuses = [self._lifting_status() if is_active else self._waiting_status()]
        if self._stage is not Stage.UNCONFIGURED:
            statuses.append(self._training.status)
        self._diagnostics_publisher.publish(
            DiagnosticArray(header=publishing.to_header(self._now()), status=statuses)
        )

    def _waiting_status(self) -> DiagnosticStatus:
        """Return the state of a managed node that is not active, for diagnostics."""
        assert self._lifecycle
        problem, state = self._lifecycle.problem, self._lifecycle.state
        node = self.get_fully_qualified_name()
        message = problem or f"{state}: waits for a transition (ros2 lifecycle set {node})"
        values = {"state": state, "model": self.get_parameter("model").value}
        return status(f"{node}: lifting", ERROR if problem else OK, message, values, node)

    def _lifting_status(self) -> DiagnosticStatus:
        """Return how the lifting goes, for diagnostics; look at the input."""
        idle = self._lifter_diagnostics.idle
        self._keypoint_topics.update(idle=idle)
        residual = self._lifter_diagnostics.residual
        level, message, values = self._lifter_diagnostics.report()
        self._check_input(level, residual, idle=idle)
        outside = [f for f in self._findings if f.code == "outside"]
        causes = outside or [f for f in self._findings if f.code == "layout"]
        if level == OK and self._findings or level == WARN and causes or outside:
            level, message = max(level, WARN), str((causes or self._findings)[0])
        values["findings"] = "; ".join(map(str, self._findings)) or "none"
        values["keypoint layout"] = self._layout_status()
        model = self._pipeline.model
        values["wrong keypoints"] = self._wrong_check.text(model.layout.keypoints)
        values |= {"model": model.name, "topic": ", ".join(self._keypoint_topics.topics)}
        values["history"] = self._pipeline.history_status
        frame = self._last_frame or self._frame_id or self._camera.frame
        if self._depth is not None:
            values |= self._depth.report()
            if level == OK and self._depth.problem:
                level, message = WARN, self._depth.problem
        gravity = self._against_gravity(Header(frame_id=frame))
        values["gravity"] = gravity.status
        if gravity.up is not None and gravity.source != self._gravity_source:
            self._gravity_source = gravity.source
            self.get_logger().info(f"gravity: {gravity.status}")
        if self._floor:
            values["floor"] = self._floor_status(known=gravity.up is not None)
        for identity, bones in self._pipeline.learned_bones(shown=self._present()).items():
            values[f"bones of {identity}"] = bones
        values |= {"subscribed": self._keypoint_topics.description, "camera": self._camera.status}
        node = self.get_fully_qualified_name()
        return status(f"{node}: lifting", level, message, values, node)

    def _floor_status(self, *, known: bool) -> str:
        """Return what the floor says of the last objects, for diagnostics.

        Args:
            known: whether the direction of gravity is.
        """
        text = f"{self._camera_options.camera_height:g} m below the camera"
        if not known:
            return f"{text}; not used: the direction of gravity is not known"
        names, scales = self._floor_sizes
        sizes = (f"{name.split(' ', 1)[-1]} {s:.2f}" for name, s in zip(names, scales, strict=True))
        return f"{text}; times the assumed size: {', '.join(sizes) or 'nobody yet'}"

    def _present(self) -> dict[str, NDArray[np.float32]]:
        """Return the shape as published of each identity in the last message of its topic."""
        since = time.monotonic() - _PRESENT
        self._scenes = {topic: last for topic, last in self._scenes.items() if last[0] > since}
        return {
            name: shape
            for _, scene in self._scenes.values()
            for name, shape in zip(scene.identities, scene.lifted.shapes, strict=True)
            if name and np.isfinite(shape).all()
        }

    def _layout_status(self) -> str:
        """Return the layout of the keypoints as text, for diagnostics."""
        if self._stream.searching:
            return "auto: not known yet, the first messages will show it"
        name = self._pipeline.source.name
        return f"{name} (auto: {self._chosen.reason})" if self._chosen else name

    def _check_input(self, level: int, residual: float, *, idle: bool) -> None:
        """Look at the last messages; log what looks wrong, at a limited rate.

        It looks in the first reports, while something looks wrong, and then once in 10 s; at
        gravity and the floor always.

        Args:
            level: of the diagnostics.
            residual: median residual of the last second; NaN if nothing was lifted.
            idle: there was no message in the last second.
        """
        if idle:
            self._findings, self._checks = [], 0
            return
        self._checks += 1
        early, scene = self._checks <= _EARLY_CHECKS, self._scene_findings()
        found = bool(self._findings or scene)
        if not (early or found or level != OK or self._checks % _CHECK_EVERY == 0):
            return
        size = self._camera.size
        try:
            poor = level == ERROR or residual >= POOR_RESIDUAL
            choice = self._stream.choose(self._pipeline, size) if poor and self._auto else None
            if choice:
                self._set_layout(choice)
            self._findings = self._stream.look(
                self._pipeline, size, self._camera.intrinsics, residual
            )
            self._findings += scene
            inputs = parameter_bridge.read(self, InputOptions)
            if bool(inputs.image_width) != bool(inputs.image_height):
                text = (
                    f"image_width is {inputs.image_width} and image_height is "
                    f"{inputs.image_height}: the size of the image needs both"
                )
                self._findings.insert(0, Finding("image-size", text))
        except Exception as problem:  # looking must not end the node
            self.get_logger().warning(
                f"the input could not be looked at: {_error_text(problem)}",
                throttle_duration_sec=_FINDING_PERIOD,
            )
        now = time.monotonic()
        for finding in self._findings:
            if now - self._logged.get(finding.code, -math.inf) >= _FINDING_PERIOD:
                self._logged[finding.code] = now
                self.get_logger().warning(str(finding))

    def _scene_findings(self) -> list[Finding]:
        """Return whether the people of the last seconds contradict gravity or the floor."""
        gravity = self._against_gravity(Header(frame_id=self._last_frame))
        layout, trunk = self._pipeline.model.layout, self._pipeline.reference_length
        return [
            *self._wrong_check.find(layout.keypoints),
            *self._gravity_check.find(gravity.source, gravity.mend),
            *self._floor_check.find(
                self._camera_options.camera_height, trunk if layout.reference == TRUNK else None
            ),
        ]

    def _build_pipeline(self, changes: Sequence[Parameter]) -> Pipeline:
        """Return the pipeline for the parameters after `changes`; raise ValueError if invalid."""
        inputs = parameter_bridge.read(self, InputOptions, changes=changes)
        if not self._camera_options.camera_info and self._view.field_of_view:
            self._check_image_size(inputs, changes)
            self._view.intrinsics(inputs.image_size)
        self._training_parameters(changes)
        parameter_bridge.read(self, GravityOptions, _GRAVITY, changes)
        # A file is read only when its parameter is set: it may have been deleted since.
        changed = {change.name for change in changes} or {"model", "keypoint_layout"}
        model: Model
        detector: KeypointLayout | None
        if "model" in changed:
            model = load_model(self._sandbox.model("model", inputs.model))
        else:
            model = self._pipeline.model
        if inputs.keypoint_layout == AUTO:
            detector = self._layout_so_far(model)
        elif "keypoint_layout" not in changed:
            detector = self._pipeline.detector
        elif inputs.keypoint_layout == MODEL_ORDER:
            detector = None
        else:
            word = self._sandbox.layout("keypoint_layout", inputs.keypoint_layout)
            detector = find_layout("keypoint_layout", word)
        return self._assemble(model, detector, changes)

    def _assemble(
        self, model: Model, detector: KeypointLayout | None, changes: Sequence[Parameter] = ()
    ) -> Pipeline:
        """Return the pipeline of a model and a layout for the parameters after `changes`."""
        return Pipeline(
            model,
            detector,
            parameter_bridge.read(self, InputOptions, changes=changes),
            parameter_bridge.read(self, LiftingOptions, changes=changes),
            parameter_bridge.read(self, SmoothingOptions, _SMOOTHING, changes),
            parameter_bridge.read(self, HistoryOptions, _HISTORY, changes),
        )

    def _layout_so_far(self, model: Model) -> KeypointLayout | None:
        """Return the layout that was chosen for the input, if a model can lift it."""
        if self._chosen is None or self._chosen.layout.keypoints == model.layout.keypoints:
            return None
        try:
            KeypointMap(self._chosen.layout, model.layout)
        except ValueError:  # they share too few keypoints
            return None
        return self._chosen.layout

    def _check_parameters(self, changes: Sequence[Parameter]) -> None:
        """Raise ValueError for a value that no model could have; the rest is for `configure`."""
        parameter_bridge.read(self, InputOptions, changes=changes)
        parameter_bridge.read(self, LiftingOptions, changes=changes)
        parameter_bridge.read(self, SmoothingOptions, _SMOOTHING, changes)
        parameter_bridge.read(self, HistoryOptions, _HISTORY, changes)
        parameter_bridge.read(self, GravityOptions, _GRAVITY, changes)
        self._training_parameters(changes)

    def _validate_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        """Build a pipeline for changed parameters, or refuse them with the reason."""
        try:
            if self._stage is Stage.UNCONFIGURED:
                self._check_parameters(changes)
            else:
                self._proposed = self._build_pipeline(changes)
        except Exception as problem:  # a bad parameter must not end the node
            reason = _error_text(problem)
            if isinstance(problem, TooFewSharedError):
                reason += _one_at_a_time(changes)
            return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _apply_parameters(self, changes: list[Parameter]) -> None:
        """Swap in the pipeline of the accepted parameters."""
        if self._stage is Stage.UNCONFIGURED:
            return
        if self._proposed.model is not self._pipeline.model:
            self.get_logger().info(f"lifting with model {self._proposed.model.name!r}")
        search = parameter_bridge.read(self, InputOptions).keypoint_layout == AUTO
        self._bodies.describe(self._proposed.model.layout)
        if self._proposed.model is not self._pipeline.model or search != self._auto:
            self._auto, self._chosen = search, None
            self._stream.restart(search=search)
        self._pipeline = self._proposed
        self._camera.set_image_size(self._pipeline.image_size)
        self._up = parameter_bridge.read(self, GravityOptions, _GRAVITY).direction
        self._forget_scene()
        for warning in self._unused_options(changes):
            self.get_logger().warning(warning)

    def _check_image_size(self, inputs: InputOptions, changes: Sequence[Parameter]) -> None:
        """Raise ValueError if a field of view would have a size that nobody means.

        Args:
            inputs: the parameters after the changes.
            changes: of parameters; empty at the start.
        """
        view, width, height = self._view.field_of_view, inputs.image_width, inputs.image_height
        sides = {"image_width": width, "image_height": height}
        if missing := [name for name, side in sides.items() if not side and any(sides.values())]:
            raise ValueError(
                f"field_of_view is {view:g} and needs the size of the image: image_width is "
                f"{width} and image_height is {height}; set {missing[0]}"
            )
        # At the start, and of an equal value, a change of one side is none of the camera.
        changed = [change.name for change in changes if change.name in sides]
        if len(changed) == 1 and sides[changed[0]] != self.get_parameter(changed[0]).value:
            raise ValueError(
                f"{changed[0]} alone would make the image {width} x {height}, and the camera of "
                f"field_of_view {view:g} depends on both: set image_width and image_height in one "
                "call (set_parameters_atomically)"
            )

    def _unused_options(self, changes: Sequence[Parameter] = ()) -> list[str]:
        """Return a warning for each parameter without effect that is among `changes` or new."""
        lifting = parameter_bridge.read(self, LiftingOptions)
        warnings = unused_options(
            parameter_bridge.read(self, InputOptions),
            lifting,
            parameter_bridge.read(self, SmoothingOptions, _SMOOTHING),
            parameter_bridge.read(self, HistoryOptions, _HISTORY),
            self._pipeline.model.layout,
        )
        up = parameter_bridge.read(self, GravityOptions, _GRAVITY)
        sources = parameter_bridge.read(self, GravitySources, _GRAVITY)
        if self._floor:
            height = parameter_bridge.read(self, CameraOptions).camera_height
            warnings |= unused_height(height, up, sources, self._target.name)
        else:
            warnings |= unused_gravity(up, sources, lifting, self._pipeline.model.layout)
        warnings |= unused_depth(self._depth_options)
        changed = {change.name for change in changes}
        said, self._unused = self._unused, frozenset(warnings)
        return list({t: 0 for name, t in warnings.items() if name in changed or name not in said})

    def _training_request(self) -> TrainingRequest:
        """Return the training that the present parameters ask for."""
        if self._stage is not Stage.ACTIVE:
            raise ValueError(
                f"the lifter is {self._stage.value}, so it has no keypoint topic to train on: "
                "activate it first"
            )
        inputs, topics = parameter_bridge.read(self, InputOptions), self._keypoint_topics.topics
        layout = inputs.keypoint_layout
        if layout == AUTO and self._pipeline.detector:
            layout = self._pipeline.detector.name
        lifter = LifterInput(
            topic=topics[0] if len(topics) == 1 else "",
            keypoint_layout=self._sandbox.layout("keypoint_layout", layout),
            model=self._sandbox.model("model", inputs.model),
            min_confidence=inputs.min_confidence,
            min_score=inputs.min_score,
            mapping=inputs.input_type if inputs.input_type.endswith(MAPPING_SUFFIXES) else "",
            image_width=inputs.image_width,
            image_height=inputs.image_height,
        )
        return training_request(self._training_parameters(), lifter, self._sandbox)

    def _training_parameters(self, changes: Sequence[Parameter] = ()) -> TrainingParameters:
        """Return the parameters `train.*` after `changes`; raise ValueError for a wrong one."""
        return TrainingParameters(
            parameter_bridge.read(self, TrainingOptions, _TRAIN, changes),
            parameter_bridge.read(self, Recipe, _TRAIN, changes),
            parameter_bridge.read(self, LayoutLossWeights, _TRAIN, changes),
            parameter_bridge.read(self, Limits, _TRAIN, changes),
            parameter_bridge.read(self, Curation, _TRAIN, changes),
        )

    def _switch_model(self, path: str) -> None:
        """Lift with the model in a file of the models folder; raise ValueError if refused."""
        (result,) = self.set_parameters([Parameter("model", value=Path(path).stem)])
        if not result.successful:
            raise ValueError(result.reason)


def _names_of(topic: str, identities: Sequence[str]) -> list[str]:
    """Return identities that are unique over all topics; "" stays."""
    return [identity and f"{topic} {identity}" for identity in identities]


def _one_at_a_time(changes: Sequence[Parameter]) -> str:
    """Return how model and layout can be exchanged if `changes` has but one of them, else ""."""
    if {"model", "keypoint_layout"} <= {change.name for change in changes}:
        return ""
    return (
        ". To exchange model and keypoint_layout, set keypoint_layout to 'model' first, then "
        "model, then keypoint_layout if the detector has another order; or set both in one call "
        "(set_parameters_atomically)"
    )


def _error_text(problem: Exception) -> str:
    """Return the text of an error for logs, statuses and refusals."""
    if isinstance(problem, (ValueError, OSError)):
        return str(problem)
    return f"internal error: {problem!r}"


def _start_error(problem: Exception) -> str:
    """Return why rclpy cannot start, with the remedy where it is known."""
    text = str(problem)
    if "same type" in text:
        text += (
            "\nWrite all numbers of a list with a decimal point: [0.0, -0.94, -0.34], not "
            "[0, -0.94, -0.34]"
        )
    return text


def main() -> None:
    """Run the node until SIGINT or SIGTERM; exit with 0, or with 1 if it cannot start."""
    # rclpy's own handlers call these and shut the context down, which ends `spin`. The list serves
    # a signal before that, or during a call to ROS, which fails because of it.
    signals: list[int] = []
    for number in _SIGNALS:
        signal.signal(number, lambda number, _: signals.append(number))
    # An executor that a signal interrupts in its constructor fails once more when it is destroyed.
    sys.unraisablehook = lambda error: None if signals else sys.__unraisablehook__(error)
    try:
        rclpy.init()
    except Exception as problem:  # such as a malformed parameter; rclpy has no public class for it
        print(f"cannot start: {_start_error(problem)}", file=sys.stderr)
        sys.exit(1)
    try:
        if not signals:
            _run()
    except ExternalShutdownException:
        pass
    except Exception:
        # The executor fails on a context that is shut down before Python has called our handler.
        if not signals and rclpy.ok():
            raise
    finally:
        shut_down()
        # Launchers and terminals send the signal twice; the second must not kill Python's shutdown.
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)


def _run() -> None:
    """Lift until the context is shut down."""
    try:
        node = LifterNode()
    except (ParameterException, ValueError, OSError) as problem:
        rclpy.logging.get_logger("lifter").fatal(f"cannot start: {problem}")
        sys.exit(1)
    try:
        # rclpy prints a traceback for an executor whose context a signal has shut down already.
        if rclpy.ok():
            _spin(node)
    finally:
        node.close()
        node.destroy_node()


def _spin(node: LifterNode) -> None:
    """Serve the node until the context is shut down."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    finally:
        executor.shutdown()


if __name__ == "__main__":
    main()
