# SPDX-License-Identifier: Apache-2.0
"""The services ~/train and ~/cancel_training and the topic ~/training_status."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing, suppress
from itertools import islice
from pathlib import Path
from queue import Empty, SimpleQueue

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger

from deep_nrsfm_ros.data.bag_files import BagError, BagFile, open_bag, opens_quickly
from deep_nrsfm_ros.data.bag_topics import keypoint_topics
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import LAYOUTS
from deep_nrsfm_ros.lifting.observation import MessageError
from deep_nrsfm_ros.messages.options import AUTO
from deep_nrsfm_ros.messages.serialised import MessageReader
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, Model, load_model
from deep_nrsfm_ros.node import publishing
from deep_nrsfm_ros.node.diagnostics import ERROR, OK, WARN, status
from deep_nrsfm_ros.training.activation import reason_to_stay, switch_commands
from deep_nrsfm_ros.training.config import PARAMETERS, DataConfig, TrainingConfig
from deep_nrsfm_ros.training.job import JobStatus, TrainingJob
from deep_nrsfm_ros.training.record import find_records, read_record
from deep_nrsfm_ros.training.request import TrainingRequest, data_in_words
from deep_nrsfm_ros.training.same_name import BEFORE
from deep_nrsfm_ros.training.validation import find_layouts, read_field_mapping
from deep_nrsfm_ros.training.verdicts import ALONE, AS_GOOD, BETTER, DOUBTFUL
from deep_nrsfm_ros.wording import in_node

_SAMPLE = 16
"""Messages of a bag that are read before a training is accepted."""
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def check_keypoint_counts(config: TrainingConfig) -> None:
    """Read the first messages of each bag, which takes milliseconds.

    Bags that are too large to open at once, and files, are not looked at.

    Raises:
        ValueError: the messages have another number of keypoints than their layout in every bag,
            so a training of them would fail as soon as they are read.
    """
    data, (source, target) = config.data, find_layouts(config, PARAMETERS)
    if not source.keypoints or data.inputs:
        return
    counts = [len(source)]
    if not data.keypoint_layout:  # the training takes the layout that fits
        counts += {len(layout) for layout in LAYOUTS.values() if _maps(layout, target)}
    reason = ""
    for path in map(Path.expanduser, data.bags):
        if not opens_quickly(path):
            return
        try:
            with closing(open_bag(path)) as bag:
                complaints = [_wrong_count(bag, data, count) for count in counts]
                wrong = complaints[0] if all(complaints) else ""
        except BagError:  # the training leaves it out
            continue
        if not wrong:
            return
        reason = reason or f"{path.name}: {wrong}"
    if reason:
        raise ValueError(
            f"{reason}; set {PARAMETERS('keypoint_layout')}, which stands for {source.name!r} now"
        )


def _maps(layout: KeypointLayout, target: KeypointLayout) -> bool:
    """Return whether keypoints of one layout can be those of another."""
    try:
        KeypointMap(layout, target)
    except ValueError:
        return False
    return True


def _wrong_count(bag: BagFile, data: DataConfig, keypoints: int) -> str:
    """Return the complaint about the first message that has another number of keypoints.

    It is "" if one of the first messages can be read, or none has another number.
    """
    complaint = ""
    mapping = read_field_mapping(data.mapping)
    for topic, input_type, decode in keypoint_topics(bag, data.topic, mapping, keypoints):
        reader = MessageReader(input_type, decode)
        for raw in islice(bag.sample(topic), _SAMPLE):
            try:
                _, observation = reader(raw, keypoints, size=data.image_size)
                if len(observation.confidence):
                    return ""
            except MessageError as error:
                with suppress(Exception):
                    if not complaint and reader.count(raw) not in (0, keypoints):
                        complaint = str(error)
            except Exception:  # damaged bytes fail in many ways; the training counts them
                continue
    return complaint


class TrainingService:
    """Trains on request, one job at a time, and publishes its progress.

    All calls of ROS happen on the executor's thread: the thread of the job only queues progress.
    """

    def __init__(
        self,
        node: Node,
        request: Callable[[], TrainingRequest],
        activate: Callable[[str], None],
        present: Callable[[], Model],
        source: Callable[[], KeypointLayout],
        folder: Path,
    ) -> None:
        """Offer the services on `node`.

        Args:
            node: the lifter.
            request: returns the training that the present parameters ask for; raises ValueError.
            activate: switches to the model in a file; raises ValueError if it cannot.
            present: returns the model that the lifter has.
            source: returns the layout in which it receives keypoints.
            folder: folder of models and of the records of trainings.
        """
        self._node, self._request, self._activate = node, request, activate
        self._present, self._source = present, source
        self._folder = folder
        self._job: TrainingJob | None = None
        self._closed = False
        self._name, self._activate_when = "", "if_better"
        self._state, self._last_failure = "idle", "none"
        self._switched = "", ""  # name of the model that the last training put in use; what said so
        self._progress: SimpleQueue[JobStatus] = SimpleQueue()
        self._wake = node.create_guard_condition(self._report)
        self._publisher = node.create_publisher(
            DiagnosticStatus,
            "~/training_status",
            _LATCHED,
            event_callbacks=publishing.NO_EVENT_CALLBACKS,
        )
        node.create_service(Trigger, "~/train", self._train)
        node.create_service(Trigger, "~/cancel_training", self._cancel)
        self._report_records()

    def close(self, timeout: float) -> None:
        """End a training that runs, by force after `timeout` seconds; report nothing any more."""
        self._closed = True
        if self._job:
            self._job.close(timeout)

    def _report_records(self) -> None:
        """Report the trainings that were cut off before the lifter started, and how to go on."""
        message = "no training since the lifter started"
        records = find_records(self._folder)
        for record in records:
            text = f"{record}: {record.advice}"
            self._node.get_logger().warning(text)
            message += f"; {text}"
        names = {"unfinished": ", ".join(record.name for record in records)} if records else {}
        self._publish(JobStatus("idle", message, {**names}))

    @in_node()
    def _train(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Start a training and answer at once."""
        try:
            if self._job:
                raise ValueError(
                    f"training of {self._name!r} is under way; wait, or call ~/cancel_training"
                )
            request = self._request()
            config, warning = request.accept()
            check_keypoint_counts(config)
            self._job = TrainingJob(config, self._enqueue)
        except (ValueError, OSError) as problem:
            response.success, response.message = False, str(problem)
            return response
        self._name, self._activate_when = config.output.name, request.activate
        data = data_in_words(config.data)
        if config.resume:
            data = "the data that it began with"
        response.success = True
        response.message = f"training {self._name!r} on {data}"
        if config.start and not config.resume:
            response.message += f", starting from model {Path(config.start).stem!r}"
        if warning:
            response.message += f"; {warning}"
            self._node.get_logger().warning(warning)
        self._publish(JobStatus("starting", f"starting on {data}", {}))
        return response

    def _cancel(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Ask the training to end."""
        response.success = self._job is not None
        response.message = "no training is under way"
        if self._job:
            self._job.cancel()
            response.message = f"cancelling the training of {self._name!r}"
        return response

    def _enqueue(self, progress: JobStatus) -> None:
        """Pass progress from the job's thread to the executor's."""
        if self._closed:
            return
        self._progress.put(progress)
        self._wake.trigger()

    def _report(self) -> None:
        """Publish the progress that the job has queued."""
        while True:
            try:
                progress = self._progress.get_nowait()
            except Empty:
                return
            if progress.ended:
                self._job = None
            if progress.state in ("failed", "cancelled"):
                progress = self._with_advice(progress)
            if progress.state == "finished":
                progress = self._switch(progress)
            self._publish(progress)

    def _with_advice(self, progress: JobStatus) -> JobStatus:
        """Return the end of a training with how to continue it, if it can be continued."""
        record = read_record(self._folder, self._name)
        if not record:
            return progress
        return progress._replace(message=f"{progress.message}\n{record}: {record.advice}")

    @property
    def status(self) -> DiagnosticStatus:
        """The state of the last training; a model that it put in use may be so no longer."""
        name, said = self._switched
        now = self._present().name
        message = self._status.message
        if said and now != name:
            message = message.replace(said, f"was in use; the lifter has model {now!r} now")
        status = self._status
        return DiagnosticStatus(
            level=status.level,
            name=status.name,
            message=message,
            hardware_id=status.hardware_id,
            values=status.values,
        )

    def _switch(self, progress: JobStatus) -> JobStatus:
        """Activate the model of a finished training, if it should be, and say so."""
        if self._activate_when == "never":
            return progress
        model = str(progress.values.get("model", ""))
        if self._activate_when == "if_better":
            if progress.values.get("judgement") not in (BETTER, AS_GOOD, ALONE):
                return progress._replace(message=f"{progress.message}; not in use (train.activate)")
            if reason := self._reason_to_stay(model):
                how = f"to switch: {self._how_to_switch(model)}"
                return progress._replace(
                    message=f"{progress.message}; not in use (train.activate): {reason}; {how}"
                )
        before, name = str(self._node.get_parameter("model").value), Path(model).stem
        try:
            self._activate(model)
        except ValueError as problem:
            return progress._replace(message=f"{progress.message}; not in use: {problem}")
        if before == name:  # the file that it replaced
            before = f"{name}{BEFORE}"
        said = f"in use from now on; a lifter that is started anew needs -p model:={name}"
        if before != name + BEFORE or (self._folder / f"{before}{MODEL_SUFFIX}").exists():
            node = self._node.get_fully_qualified_name()
            said += f"; to go back to model {before!r}: ros2 param set {node} model {before}"
        self._switched = self._present().name, said
        return progress._replace(message=f"{progress.message}; {said}")

    def _how_to_switch(self, file: str) -> str:
        """Return the commands that have the lifter take the model in a file."""
        node = self._node.get_fully_qualified_name()
        # A lifter whose keypoint_layout is auto looks for the layout of its input anew.
        is_named = self._node.get_parameter("keypoint_layout").value != AUTO
        other = is_named and not _maps(self._source(), load_model(Path(file)).layout)
        return ", and then ".join(switch_commands(node, Path(file).stem, other_object=other))

    def _reason_to_stay(self, file: str) -> str:
        """Return why the lifter should not switch to the model in a file by itself, or ""."""
        try:
            return reason_to_stay(load_model(Path(file)), self._present())
        except ValueError:  # damaged: to switch to it fails with the reason
            return ""

    def _publish(self, progress: JobStatus) -> None:
        """Publish progress, and log it where the state changes or there is a message."""
        failed = progress.state == "failed"
        warns = not progress.values and progress.message.startswith("warning: ")
        warns |= bool(progress.values.get("warning"))
        warns |= progress.values.get("judgement") == DOUBTFUL
        news = f"training of {self._name!r}: {progress.message}"
        if failed:
            self._node.get_logger().error(news)
            self._last_failure = news
        elif warns:
            self._node.get_logger().warning(news)
        elif progress.state != "idle" and (progress.state != self._state or not progress.values):
            self._node.get_logger().info(news)  # a new state, or no step but something to say
        if progress.state == "finished":
            self._last_failure = "none"
        self._state = progress.state
        node = self._node.get_fully_qualified_name()
        values = {"state": progress.state, **progress.values, "last failure": self._last_failure}
        level = ERROR if failed else WARN if warns else OK
        self._status = status(f"{node}: training", level, progress.message, values, node)
        self._publisher.publish(self._status)
