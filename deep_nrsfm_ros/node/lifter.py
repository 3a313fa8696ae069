"""The node `lifter`: 2D keypoints in, 3D points and the camera's rotation out.

Every message on `keypoints` is answered, with its own header, on

- ~/points: n objects (rows) of p keypoints: x right, y down, z forward, and confidence; at their
  place before the camera if its CameraInfo is known, else centred on each object's keypoints; in
  units of the parameter reference_length; NaN where too few keypoints are visible,
- ~/camera_rotation: from the axes of the first object (x front, y left, z up, where its layout
  says which is which) to those of the camera; left out when the first object is NaN,
- ~/objects: who is in which row, and the rotation of each; made only when someone listens,
- ~/markers: the same for RViz, made only when someone listens,
- /tf: a frame for each object, if the parameter tf_prefix asks for it.

It never imports torch: lifting is NumPy, and training is a process of its own.
"""

from __future__ import annotations

import math
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import QuaternionStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from visualization_msgs.msg import MarkerArray

from deep_nrsfm_ros.data.curation import Curation
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.lifter import LiftingOptions
from deep_nrsfm_ros.lifting.smoothing import SmoothingOptions
from deep_nrsfm_ros.messages.pipeline import MODEL_ORDER, InputOptions, Pipeline
from deep_nrsfm_ros.messages.serialised import Header
from deep_nrsfm_ros.model_files.find_layout import find_layout
from deep_nrsfm_ros.model_files.model_file import Model, load_model
from deep_nrsfm_ros.model_files.path_sandbox import PathSandbox
from deep_nrsfm_ros.node import parameters, publishing
from deep_nrsfm_ros.node.camera import CameraInfoSubscription, CameraOptions
from deep_nrsfm_ros.node.diagnostics import Health, status
from deep_nrsfm_ros.node.subscriptions import LOG_PERIOD, KeypointSubscriptions, KeypointTopic
from deep_nrsfm_ros.node.training_service import TrainingService
from deep_nrsfm_ros.node.transforms import TransformBroadcaster
from deep_nrsfm_ros.nrsfm.recipe import LayoutLossWeights, Recipe
from deep_nrsfm_ros.training.limits import Limits
from deep_nrsfm_ros.training.request import (
    TrainingOptions,
    TrainingRequest,
    layouts,
    limited,
    paths_of,
    sandboxed,
)

_STEADY = "smoothing."
_TRAIN = "train."
_REPORT_PERIOD = 1.0
_ENDING = (signal.SIGINT, signal.SIGTERM)
_END_OF_TRAINING = 1.0  # seconds that a training has to save its model when the node ends


class LifterNode(Node):
    """Lifts every message on `keypoints` with the model that the parameters name."""

    def __init__(self) -> None:
        """Declare parameters, load the model and start to listen.

        Raises ValueError or ParameterException if a parameter or the model is not usable.
        """
        super().__init__("lifter")
        self._inputs = parameters.declare(self, InputOptions)
        parameters.declare(self, LiftingOptions)
        camera = parameters.declare(self, CameraOptions)
        parameters.declare(self, SmoothingOptions, _STEADY)
        training = parameters.declare(self, TrainingOptions, _TRAIN)
        parameters.declare(self, Recipe, _TRAIN)
        parameters.declare(self, LayoutLossWeights, _TRAIN)
        parameters.declare(self, Limits, _TRAIN)
        parameters.declare(self, Curation, _TRAIN)
        self._fence = PathSandbox(
            Path(self._inputs.models_dir).expanduser(),
            Path(self._inputs.bags_dir).expanduser(),
            (self._inputs.model, self._inputs.keypoint_layout, *paths_of(training)),
        )
        self._pipeline = self._proposed = self._prepare(())

        self._camera = CameraInfoSubscription(self, camera)
        self._tf = TransformBroadcaster(self, camera.tf_prefix) if camera.tf_prefix else None
        self._health = Health()
        self._points = self._unwatched(PointCloud2, "~/points")
        self._rotation = self._unwatched(QuaternionStamped, "~/camera_rotation")
        self._objects = self._unwatched(MultiDOFJointState, "~/objects")
        self._markers = self._unwatched(MarkerArray, "~/markers")
        self._diagnostics = self._unwatched(DiagnosticArray, "/diagnostics")
        self._training = TrainingService(
            *(self, self._training_request, self._activate, self._fence.models_dir)
        )
        # Not in ROS time: a simulation that pauses, or jumps back, would silence it.
        self.create_timer(
            _REPORT_PERIOD, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        self.add_on_set_parameters_callback(self._consider)
        self.add_post_set_parameters_callback(self._adopt)
        self.get_logger().info(
            f"lifting with model {self._pipeline.model.name!r} {len(self._pipeline.source)} "
            f"keypoints in the order of {self._pipeline.source.name!r}"
        )
        health = self._health
        self._listener = KeypointSubscriptions(
            self, self._inputs, self._lift, health.unheard, health.missed
        )

    def _unwatched(self, kind: type, topic: str) -> Publisher:
        return self.create_publisher(kind, topic, 10, event_callbacks=publishing.NO_EVENT_CALLBACKS)

    def close(self) -> None:
        """End a training that runs."""
        self._training.close(_END_OF_TRAINING)

    def _lift(self, source: KeypointTopic, raw: bytes) -> None:
        """Lift one serialised message and publish the result: the hot path."""
        started = time.perf_counter()
        try:
            intrinsics = self._camera.known()
            header, seen = self._pipeline.read(raw, source.reader, self._camera.size)
            told = self._objects.get_subscription_count()
            wanted = told or self._tf or self._pipeline.steadies
            identities = source.tracker(seen, started) if wanted else ("",) * len(seen.confidence)
            header = header or self._now()
            if not header.frame_id:
                header = header._replace(frame_id=self._camera.frame)
            seconds = 1e-9 * (header.stamp or self._now().stamp)
            lifted, identities = self._pipeline.lift(
                seen, intrinsics, identities, source.topic, seconds
            )
        except Exception as problem:  # whatever it is, the next message may be fine
            self._reject(source, problem)
            return
        if not identities:
            self._health.saw_nothing()
            return
        positioned = self._camera.wanted
        self._points.publish(publishing.point_cloud(header, lifted))
        if not math.isnan(lifted.residual[0]):
            self._rotation.publish(publishing.camera_rotation(header, lifted.rotations[0]))
        if told:
            self._objects.publish(
                publishing.objects(header, lifted, identities, positioned=positioned)
            )
        if self._tf:
            self._tf.send(header, lifted, identities)
        if self._markers.get_subscription_count():
            edges = self._pipeline.edges
            self._markers.publish(publishing.markers(header, lifted, edges, positioned=positioned))
        self._health.lifted(time.perf_counter() - started, lifted.residual, lifted.confidence)

    def _reject(self, source: KeypointTopic, problem: Exception) -> None:
        """Count a message that could not be lifted; say why, but not too often."""
        reason = _words(problem)
        self._health.rejected(reason)
        self.get_logger().warning(
            f"message on {source.topic} dropped: {reason}", throttle_duration_sec=LOG_PERIOD
        )

    def _now(self) -> Header:
        """Return a header for input that has none: now, and no frame."""
        return Header(*self.get_clock().now().seconds_nanoseconds())

    def _report(self) -> None:
        """Publish diagnostics."""
        self._listener.look(idle=self._health.idle)
        level, message, values = self._health.report()
        model = self._pipeline.model
        values |= {"model": model.name, "topic": ", ".join(self._listener.topics)}
        values |= {"heard": self._listener.heard, "camera": self._camera.status}
        lifting = status(f"{self.get_name()}: lifting", level, message, values)
        self._diagnostics.publish(
            DiagnosticArray(
                header=publishing.to_header(self._now()), status=[lifting, self._training.status]
            )
        )

    def _prepare(self, changes: Sequence[Parameter]) -> Pipeline:
        """Return the pipeline as it will be with `changes`; raise ValueError if it cannot be."""
        inputs = parameters.read(self, InputOptions, changes=changes)
        lifting = parameters.read(self, LiftingOptions, changes=changes)
        steadying = parameters.read(self, SmoothingOptions, _STEADY, changes)
        for checked in (TrainingOptions, Recipe, LayoutLossWeights, Limits, Curation):
            parameters.read(self, checked, _TRAIN, changes)
        # Files are read again only when they are named again: they may be gone by now.
        changed = {change.name for change in changes} or {"model", "keypoint_layout"}
        model: Model
        detector: KeypointLayout | None
        if "model" in changed:
            model = load_model(self._fence.model("model", inputs.model))
        else:
            model = self._pipeline.model
        if "keypoint_layout" not in changed:
            detector = self._pipeline.detector
        elif inputs.keypoint_layout == MODEL_ORDER:
            detector = None
        else:
            word = self._fence.layout("keypoint_layout", inputs.keypoint_layout)
            detector = find_layout("keypoint_layout", word)
        return Pipeline(model, detector, inputs, lifting, steadying)

    def _consider(self, changes: list[Parameter]) -> SetParametersResult:
        """Prepare for changed parameters, or refuse them with the reason."""
        try:
            self._proposed = self._prepare(changes)
        except Exception as problem:  # whatever it is, the lifter goes on as it was
            return SetParametersResult(successful=False, reason=_words(problem))
        return SetParametersResult(successful=True)

    def _adopt(self, changes: list[Parameter]) -> None:
        """Lift the next message as the accepted parameters say."""
        if self._proposed.model is not self._pipeline.model:
            self.get_logger().info(f"lifting with model {self._proposed.model.name!r}")
        self._pipeline = self._proposed

    def _training_request(self) -> TrainingRequest:
        """Return what ~/train is to do, as the parameters stand."""
        inputs = parameters.read(self, InputOptions)
        wanted = sandboxed(parameters.read(self, TrainingOptions, _TRAIN), self._fence)
        heard = self._fence.layout("keypoint_layout", inputs.keypoint_layout)
        topics, model = self._listener.topics, self._fence.model("model", inputs.model)
        source, target = layouts(wanted, heard, model, wanted.from_)
        return TrainingRequest(
            wanted,
            parameters.read(self, Recipe, _TRAIN),
            topic=wanted.topic or (topics[0] if len(topics) == 1 else ""),
            input_type=inputs.input_type,
            image_width=inputs.image_width,
            image_height=inputs.image_height,
            source_layout=source,
            target_layout=target,
            start=wanted.from_,
            min_confidence=inputs.min_confidence,
            output=self._fence.models_dir,
            curation=parameters.read(self, Curation, _TRAIN),
            layout_loss=parameters.read(self, LayoutLossWeights, _TRAIN),
            limits=limited(parameters.read(self, Limits, _TRAIN), wanted.max_minutes),
        )

    def _activate(self, path: str) -> None:
        """Switch to the model in a file of the models folder; raise ValueError if refused."""
        (result,) = self.set_parameters([Parameter("model", value=Path(path).stem)])
        if not result.successful:
            raise ValueError(result.reason)


def _words(problem: Exception) -> str:
    """Return what is wrong, as people are told."""
    if isinstance(problem, (ValueError, OSError)):
        return str(problem)
    return f"internal error: {problem!r}"


def main() -> None:
    """Run the node until SIGINT or SIGTERM; the exit code is 0 then, 1 if it cannot start."""
    # rclpy's handlers come on top of these and shut the context down, which ends `spin`. The
    # flag serves a signal that comes before, or amid a call to ROS, which then fails for it.
    signals: list[int] = []
    for number in _ENDING:
        signal.signal(number, lambda number, _: signals.append(number))
    rclpy.init()
    try:
        if not signals:
            _run()
    except ExternalShutdownException:
        pass
    except Exception:
        if not signals:
            raise
    finally:
        rclpy.try_shutdown()
        # Launchers and terminals send the signal twice; Python's own end would die of the second.
        for number in _ENDING:
            signal.signal(number, signal.SIG_IGN)


def _run() -> None:
    """Lift until the context is shut down."""
    try:
        node = LifterNode()
    except (ParameterException, ValueError, OSError) as problem:
        rclpy.logging.get_logger("lifter").fatal(f"cannot start: {problem}")
        sys.exit(1)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    finally:
        node.close()
        executor.shutdown()
        node.destroy_node()


if __name__ == "__main__":
    main()
