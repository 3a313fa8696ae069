# SPDX-License-Identifier: Apache-2.0
"""The lifter as a process of its own, and a client that talks to it over DDS."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import QuaternionStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from deep_nrsfm_ros.commands.demo import domain as domains
from deep_nrsfm_ros.data.bags import frames, write_bag
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import CMU31, HUMAN17
from deep_nrsfm_ros.messages.decoding import POINT_CLOUD
from deep_nrsfm_ros.model_files.model_file import Model, save_model
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from test.fixtures.forked_python import NODE, ROOT, TRAINING, ForkedPython

DEADLINE = float(os.environ.get("DEADLINE", "60"))  # seconds; a busy machine may want more
PROMPT_DISCOVERY = Path(__file__).parents[2] / "config" / "prompt_discovery.xml"
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

ENDINGS: dict[str, list[tuple[int, float, float]]] = defaultdict(list)
"""Exit code, seconds and CPU seconds from the signal to the end, of lifters, by when it came."""


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Tell how soon lifters have ended: a figure that depends on what else the machine does."""
    for when, ends in ENDINGS.items():
        codes, seconds, work = zip(*ends, strict=True)
        terminalreporter.write_line(
            f"signals {when}: {len(ends)}, {codes.count(0)} with code 0; median "
            f"{np.median(seconds):.2f} s, longest {max(seconds):.2f} s; of CPU time at most "
            f"{max(work):.2f} s"
        )


@contextmanager
def own_domain() -> Iterator[int]:
    """Take a DDS domain that no other test on this machine has, and set it for this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(PROMPT_DISCOVERY))
        with domains.own_domain() as number:
            patch.setenv("ROS_DOMAIN_ID", str(number))
            yield number


@pytest.fixture
def domain() -> Iterator[int]:
    """Give the test a DDS domain of its own."""
    with own_domain() as number:
        yield number


def save_random_model(folder: Path, name: str, layout: KeypointLayout) -> Path:
    """Write a small untrained model and return its file."""
    architecture = Architecture(widths=(16, 8))
    network = initialise(architecture, len(layout), np.random.default_rng(0))
    path = folder / f"{name}.safetensors"
    save_model(path, Model(name, network, layout, Normaliser(), np.eye(3, dtype=np.float32)))
    return path


def write_models(folder: Path) -> Path:
    """Write models `person` of human17, `joints` of cmu31 and a damaged `broken` to a folder."""
    save_random_model(folder, "person", HUMAN17)
    save_random_model(folder, "joints", CMU31)
    (folder / "broken.safetensors").write_bytes(b"\x00" * 100)
    return folder


@pytest.fixture
def models(tmp_path: Path) -> Path:
    """Return a folder of models: `person` of human17, `joints` of cmu31, a damaged `broken`.

    Beside the last two lie bags of their names, which the stand-in of a training learns them from.
    """
    folder = write_models(tmp_path / "models")
    for name in ("joints", "broken"):
        write_bag(folder / name, "/keypoints", frames(np.ones((2, 17, 2)), np.ones((2, 17))))
    return folder


class LifterProcess:
    """A lifter that runs, its log in a file."""

    def __init__(
        self,
        program: list[str],
        parameters: dict[str, Any],
        folder: Path,
        fork: bool = True,
        trains: bool = False,
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        settings = folder / "parameters.yaml"
        settings.write_text(yaml.safe_dump({"/**": {"ros__parameters": parameters}}))
        self._log = folder / "log"
        words = [*program, "--ros-args", "--params-file", str(settings)]
        with self._log.open("w") as log:
            given: dict[str, Any] = {
                "stdout": log,
                "stderr": subprocess.STDOUT,
                "start_new_session": True,
                "env": os.environ | {"PYTHONPATH": str(ROOT)},
            }
            self.process = (
                ForkedPython(words, TRAINING if trains else NODE, forks=trains, **given)
                if fork
                else subprocess.Popen([sys.executable, *words], text=True, **given)
            )

    @property
    def log(self) -> str:
        return self._log.read_text()

    @property
    def cpu_seconds(self) -> float:
        """CPU time of the process itself, which may be a zombie."""
        words = Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")

    def wait_for_log(self, text: str) -> None:
        deadline = time.monotonic() + DEADLINE
        while text not in self.log:
            assert self.process.poll() is None, f"lifter ended: {self.log}"
            assert time.monotonic() < deadline, f"no {text!r} in the log: {self.log}"
            time.sleep(0.02)

    def stop(self, number: signal.Signals, when: str) -> int:
        """Send a signal; return the exit code. `when` is the line of the summary to count it in."""
        pid, before = self.process.pid, time.monotonic()
        spent = self.cpu_seconds
        self.process.send_signal(number)
        while not os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT | os.WNOHANG):
            assert time.monotonic() < before + DEADLINE, f"still there: {self.log}"
            time.sleep(0.002)
        seconds, work = time.monotonic() - before, self.cpu_seconds - spent
        code = self.process.wait()
        ENDINGS[when].append((code, seconds, work))
        return code


StartLifter = Callable[..., LifterProcess]
"""Starts a lifter: start(program, listens, fork, trains, **parameters), see `lifters`."""


@contextmanager
def lifters(models: Path, folder: Path) -> Iterator[StartLifter]:
    """Start lifters with the model `person` and the parameters given; each must end cleanly.

    `fork=False` starts Python, for tests of the imports of a start. With `trains=True` the lifter
    has torch in memory, and its trainings are forked as well.
    """
    started: list[LifterProcess] = []

    def start(
        program: tuple[str, ...] = ("-m", "deep_nrsfm_ros.node.lifter"),
        listens: bool = True,
        fork: bool = True,
        trains: bool = False,
        **parameters: Any,
    ) -> LifterProcess:
        folders = {"models_dir": str(models), "bags_dir": str(folder)}
        usual = {"model": "person", "input_type": POINT_CLOUD}
        parameters = usual | folders | parameters
        own = folder / f"lifter{len(started)}"
        lifter = LifterProcess([*program], parameters, own, fork, trains)
        started.append(lifter)
        if listens:
            lifter.wait_for_log("subscribed to")
        return lifter

    yield start
    for lifter in started:
        if lifter.process.poll() is None:
            try:
                assert lifter.stop(signal.SIGINT, "at the end of a test") == 0, lifter.log
            finally:
                lifter.process.kill()
                lifter.process.wait()


@pytest.fixture
def start_lifter(domain: int, models: Path, tmp_path: Path) -> Iterator[StartLifter]:
    """Return the function that starts a lifter of the test's own, as `lifters` says."""
    with lifters(models, tmp_path) as start:
        yield start


class Client:
    """A node of the test: publishes keypoints, collects all that the lifter says."""

    TOPICS: dict[str, tuple[Any, Any]] = {
        "/lifter/points": (PointCloud2, 100),
        "/lifter/camera_rotation": (QuaternionStamped, 100),
        "/lifter/training_status": (DiagnosticStatus, LATCHED),
        "/diagnostics": (DiagnosticArray, 100),
    }

    def __init__(self, domain: int) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = rclpy.create_node("test_client", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.heard: dict[str, list[Any]] = defaultdict(list)
        for topic, (kind, qos) in self.TOPICS.items():
            self.listen(topic, kind, qos)
        self._parameters = AsyncParameterClient(self.node, "/lifter")
        self._publishers: list[Any] = []

    def listen(self, topic: str, kind: Any, qos: Any = 100) -> None:
        self.node.create_subscription(kind, topic, self.heard[topic].append, qos)

    def listen_to_markers(self) -> None:
        self.listen("/lifter/markers", MarkerArray)

    def publisher(self, kind: type, qos: QoSProfile | int = 100, topic: str = "keypoints") -> Any:
        """Return a publisher that the lifter has found."""
        publisher = self.node.create_publisher(kind, topic, qos)
        self._publishers.append(publisher)
        self.wait(publisher.get_subscription_count, "the lifter to find the publisher")
        return publisher

    def destroy_publishers(self) -> None:
        """Destroy what `publisher` has returned."""
        while self._publishers:
            self.node.destroy_publisher(self._publishers.pop())

    def wait(self, condition: Callable[[], Any], what: str, seconds: float = DEADLINE) -> Any:
        """Spin until the condition holds and return its value; fail after so many seconds."""
        deadline = time.monotonic() + seconds
        while not (value := condition()):
            assert time.monotonic() < deadline, f"waited in vain for {what}"
            self._executor.spin_once(timeout_sec=0.05)
        return value

    def exchange(self, publisher: Any, message: Any) -> PointCloud2:
        """Publish until the lifter answers; return its next points.

        BestCheckpoint effort may lose a message, so it is repeated now and then.
        """
        points = self.heard["/lifter/points"]
        before, sent = len(points), 0.0

        def answered() -> bool:
            nonlocal sent
            if time.monotonic() - sent > 0.5:
                publisher.publish(message)
                sent = time.monotonic()
            return len(points) > before

        self.wait(answered, "points")
        return points[before]

    def set_parameters(self, **values: Any) -> str:
        """Set parameters of the lifter at once; return the reason of a refusal, or ""."""
        assert self._parameters.wait_for_services(DEADLINE)
        wanted = [Parameter(name.replace("__", "."), value=v) for name, v in values.items()]
        future = self._parameters.set_parameters_atomically(wanted)
        self.wait(future.done, "parameters to be set")
        result = future.result().result
        assert result.successful != bool(result.reason)
        return str(result.reason)

    def describe_parameters(self, *names: str) -> list[Any]:
        assert self._parameters.wait_for_services(DEADLINE)
        future = self._parameters.describe_parameters(list(names))
        self.wait(future.done, "parameters to be described")
        return list(future.result().descriptors)

    def call(self, service: str) -> Trigger.Response:
        client = self.node.create_client(Trigger, service)
        self.wait(client.service_is_ready, service)
        # The lifter may know of this client a little later, and an answer before that is lost.
        settled = time.monotonic() + 0.2
        self.wait(lambda: time.monotonic() > settled, "the lifter to know of the client")
        future = client.call_async(Trigger.Request())
        self.wait(future.done, f"an answer of {service}")
        self.node.destroy_client(client)
        return future.result()

    def wait_for_training(self, state: str) -> DiagnosticStatus:
        """Wait for the newest training status to say `state`.

        Twice as long as for other things: a training has a low priority, so that other programs of
        a busy machine come first.
        """
        heard = self.heard["/lifter/training_status"]

        def said() -> bool:
            return bool(heard) and values(heard[-1])["state"] == state

        self.wait(said, f"training {state}", 2 * DEADLINE)
        return heard[-1]

    def wait_for_health(
        self, condition: Callable[[DiagnosticStatus, dict[str, str]], bool]
    ) -> DiagnosticStatus:
        """Wait for a new diagnostic status of lifting that fulfils the condition."""
        heard = self.heard["/diagnostics"]
        heard.clear()

        def found() -> DiagnosticStatus | None:
            for status in (s for message in heard for s in message.status):
                if status.name.endswith("/lifter: lifting") and condition(status, values(status)):
                    return status
            return None

        status = self.wait(found, "a diagnosis")
        assert isinstance(status, DiagnosticStatus)
        return status

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)


def values(status: DiagnosticStatus) -> dict[str, str]:
    """Return the values of a status by key."""
    return {pair.key: pair.value for pair in status.values}


Connect = Callable[[], Client]


@pytest.fixture
def connect(domain: int) -> Iterator[Connect]:
    """Make a client on the test's domain; call it once the lifter listens.

    Two participants find each other within 0.2 s if the waiting one is the lifter, and within
    3 s if it is the client.
    """
    clients: list[Client] = []

    def make() -> Client:
        clients.append(Client(domain))
        return clients[-1]

    yield make
    for client in clients:
        client.close()
