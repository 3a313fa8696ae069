"""The services ~/train and ~/cancel_training and the topic ~/training_status."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from queue import Empty, SimpleQueue

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger

from deep_nrsfm_ros.node import publishing
from deep_nrsfm_ros.node.diagnostics import ERROR, OK, status
from deep_nrsfm_ros.training.job import Progress, TrainingJob
from deep_nrsfm_ros.training.record import find_records, look
from deep_nrsfm_ros.training.request import TrainingOptions, TrainingRequest

_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class TrainingService:
    """Trains on request, one job at a time, and tells how it goes.

    Everything that is ROS happens on the executor's thread: the thread that listens to the
    job only queues what it hears.
    """

    def __init__(
        self,
        node: Node,
        request: Callable[[], TrainingRequest],
        activate: Callable[[str], None],
        folder: Path,
    ) -> None:
        """Offer the services on `node`.

        request: gives the request as the parameters stand; ValueError says what is wrong.
        activate: switches to the model in the file named; ValueError says why it cannot.
        folder: where models are, and what is left of trainings that were cut off.
        """
        self._node, self._request, self._activate = node, request, activate
        self._folder = folder
        self._job: TrainingJob | None = None
        self._wanted = TrainingOptions()
        self._state, self._last_failure = "idle", "none"
        self._heard: SimpleQueue[Progress] = SimpleQueue()
        self._wake = node.create_guard_condition(self._report)
        self._publisher = node.create_publisher(
            DiagnosticStatus,
            "~/training_status",
            _LATCHED,
            event_callbacks=publishing.NO_EVENT_CALLBACKS,
        )
        node.create_service(Trigger, "~/train", self._train)
        node.create_service(Trigger, "~/cancel_training", self._cancel)
        self._tell_of_unfinished()

    def close(self, timeout: float) -> None:
        """End a training that runs, by force after `timeout` seconds."""
        if self._job:
            self._job.close(timeout)

    def _tell_of_unfinished(self) -> None:
        """Say what was cut off before the lifter started, and how to go on."""
        message = "no training since the lifter started"
        found = find_records(self._folder)
        for one in found:
            text = f"{one}: {one.advice}"
            self._node.get_logger().warning(text)
            message += f"; {text}"
        names = {"unfinished": ", ".join(one.name for one in found)} if found else {}
        self._tell(Progress("idle", message, {**names}))

    def _train(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Start a training and answer at once."""
        try:
            if self._job:
                raise ValueError(
                    f"training of {self._wanted.name!r} is under way; wait, or call "
                    "~/cancel_training"
                )
            request = self._request()
            warning = request.check()
            self._job = TrainingJob(
                request.arguments(), self._hear, threads=request.options.threads
            )
        except (ValueError, OSError) as problem:
            response.success, response.message = False, str(problem)
            return response
        self._wanted = request.options
        data = f"{request.topic} of {', '.join(request.options.bags)}"
        if self._wanted.resume:
            data = "the data that it began with"
        response.success = True
        response.message = f"training {self._wanted.name!r} on {data}"
        if warning:
            response.message += f"; {warning}"
            self._node.get_logger().warning(warning)
        self._tell(Progress("starting", f"starting on {data}", {}))
        return response

    def _cancel(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Ask the training to end."""
        response.success = self._job is not None
        response.message = "no training is under way"
        if self._job:
            self._job.cancel()
            response.message = f"cancelling the training of {self._wanted.name!r}"
        return response

    def _hear(self, progress: Progress) -> None:
        """Take progress from the job's thread to the executor's."""
        self._heard.put(progress)
        self._wake.trigger()

    def _report(self) -> None:
        """Publish what the job has said since the last time."""
        while True:
            try:
                progress = self._heard.get_nowait()
            except Empty:
                return
            if progress.ended:
                self._job = None
            if progress.state in ("failed", "cancelled"):
                progress = self._with_advice(progress)
            if progress.state == "finished" and self._wanted.activate:
                progress = self._switch(progress)
            self._tell(progress)

    def _with_advice(self, progress: Progress) -> Progress:
        """Add to an untimely end how to go on, if there is something to go on from."""
        found = look(self._folder, self._wanted.name)
        if not found:
            return progress
        return progress._replace(message=f"{progress.message}\n{found}: {found.advice}")

    def _switch(self, progress: Progress) -> Progress:
        """Activate the model of a finished training and say so."""
        try:
            self._activate(str(progress.values.get("model", "")))
        except ValueError as problem:
            return progress._replace(message=f"{progress.message}; not in use: {problem}")
        return progress._replace(message=f"{progress.message}; in use from now on")

    def _tell(self, progress: Progress) -> None:
        """Publish progress; log it where the state changes."""
        failed = progress.state == "failed"
        news = f"training of {self._wanted.name!r}: {progress.message}"
        if failed:
            self._node.get_logger().error(news)
            self._last_failure = news
        elif not progress.values and progress.message.startswith("warning: "):
            self._node.get_logger().warning(news)
        elif progress.state != "idle" and (progress.state != self._state or not progress.values):
            self._node.get_logger().info(news)  # a new state, or no step but something to say
        if progress.state == "finished":
            self._last_failure = "none"
        self._state = progress.state
        name = f"{self._node.get_name()}: training"
        values = {"state": progress.state, **progress.values, "last failure": self._last_failure}
        level = ERROR if failed else OK
        self.status = status(name, level, progress.message, values)
        self._publisher.publish(self.status)
