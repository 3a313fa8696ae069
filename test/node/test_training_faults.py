# SPDX-License-Identifier: Apache-2.0
"""Real trainings that go wrong in all ways, while the lifter goes on lifting."""

from __future__ import annotations

import os
import random
import signal
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from safetensors.numpy import load_file
from sensor_msgs.msg import PointCloud2

from deep_nrsfm_ros.data.bags import frames, write_bag
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.messages.serialised import Header
from deep_nrsfm_ros.model_files.model_file import load_model
from deep_nrsfm_ros.node.publishing import point_cloud
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras
from deep_nrsfm_ros.training.checkpoint import read_checkpoint
from deep_nrsfm_ros.training.record import checkpoint_file, read_record, record_file
from test.fixtures.forked_python import children_of
from test.node.conftest import Connect, StartLifter

P = 17
KILLS, MANY_KILLS = 5, int(os.environ.get("KILLS", "50"))
RELIABLE = {"reliability": "reliable", "history": "keep_last", "depth": 1000}
EVERY_MESSAGE = {"/keypoints": {"subscription": RELIABLE}}
PATIENCE = 1200.0
SAVING_OFTEN = (str(Path(__file__).with_name("saving_often.py")),)


def views(f: int = 60, flat: bool = False) -> np.ndarray:
    """Return (f, 17, 2) views of an object that deforms, or of one in the image plane."""
    rng = np.random.default_rng(0)
    shapes = centre(rng.standard_normal((P, 3)) + 0.3 * rng.standard_normal((f, P, 3)))
    if flat:
        return 100 * (shapes[:1, :, :2] * rng.uniform(0.5, 2, (f, 1, 1)) + 0.01 * shapes[..., :2])
    return 100 * (shapes @ random_cameras(f, rng)) + [320, 240]


def write(path: Path, f: int = 60, storage: str = "sqlite3", flat: bool = False) -> str:
    write_bag(path, "/keypoints", frames(views(f, flat), np.ones((f, P))), storage)
    return str(path)


def values(status: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


def cloud(number: int) -> PointCloud2:
    """Return a message of keypoints whose stamp is its number."""
    zeros = np.zeros(1, np.float32)
    points = np.concatenate([views(1), np.zeros((1, P, 1))], -1).astype(np.float32)
    sure = np.ones((1, P), np.float32)
    seen = Lifted(points, zeros, zeros, zeros, zeros, sure, wrong=sure < 1)
    return deserialize_message(point_cloud(Header(sec=number), seen), PointCloud2)


class Stream:
    """Messages that go to the lifter while something else happens, all of which it must answer."""

    def __init__(self, client: Any) -> None:
        self.client, self.sent, self.last = client, 0, 0.0
        reliable = QoSProfile(depth=1000)
        self.publisher = client.publisher(PointCloud2, reliable)

    def go_on(self) -> None:
        """Send the next one, unless as many wait as the lifter's publisher holds answers."""
        waiting = self.sent - len(self.client.heard["/lifter/points"])
        if time.monotonic() - self.last > 0.05 and waiting < 10:
            self.publisher.publish(cloud(self.sent))
            self.sent, self.last = self.sent + 1, time.monotonic()

    def until(self, condition: Any, what: str, seconds: float = 60) -> None:
        self.client.wait(lambda: (self.go_on(), condition())[1], what, seconds)

    def assert_all_answered(self) -> None:
        heard = self.client.heard["/lifter/points"]
        self.client.wait(lambda: len(heard) >= self.sent, "all answers", PATIENCE)
        assert [message.header.stamp.sec for message in heard] == [*range(self.sent)]


def recorded(models: Path) -> bool:
    """Tell whether the training "fresh" has its record; for a moment there is an empty one."""
    record = record_file(models, "fresh")
    return record.exists() and record.stat().st_size > 0


def test_kills_at_random_moments_cost_no_message_and_no_model(
    start_lifter: StartLifter, connect: Connect, models: Path, tmp_path: Path
) -> None:
    (models / "broken.safetensors").unlink()
    lifter = start_lifter(
        trains=True,
        qos_overrides=EVERY_MESSAGE,
        train={"bags": [write(tmp_path / "bag")], "name": "fresh", "steps": 300, "seeds": 1,
               "batch": 8},
    )  # fmt: skip
    client, moments = connect(), random.Random(0)
    stream = Stream(client)
    status = client.heard["/lifter/training_status"]
    ended = ("failed", "finished")
    for i in range(KILLS):
        assert client.call("/lifter/train").success
        status.clear()  # a training may end before it is killed
        if i % 2:  # in the training proper, else anywhere from the start on
            stream.until(lambda: recorded(models), "the record")
        kill_at = time.monotonic() + moments.uniform(0.0, 2.5)
        stream.until(lambda at=kill_at: time.monotonic() > at, "the moment")
        for pid in children_of(lifter.process.pid):
            os.kill(pid, signal.SIGKILL)
        stream.until(lambda: status and values(status[-1])["state"] in ended, "the end")
        failure = status[-1]
        if values(failure)["state"] == "failed":
            assert failure.level == b"\x02" and "SIGKILL" in failure.message
            if recorded(models):
                assert "train.resume to true" in failure.message
                assert f"--resume --name fresh --output {models}" in failure.message
        for path in models.glob("*.safetensors"):
            load_model(path)
    if not recorded(models):  # the last was killed too early, or too late
        assert client.call("/lifter/train").success
        stream.until(lambda: recorded(models), "the record")
        for pid in children_of(lifter.process.pid):
            os.kill(pid, signal.SIGKILL)
        client.wait_for_training("failed")
    client.set_parameters(train__resume=True, train__bags=[""], train__steps=7)
    status.clear()
    accepted = client.call("/lifter/train")
    assert accepted.success and "steps was 300, is 7 now; it keeps to" in accepted.message
    stream.until(lambda: status and values(status[-1])["state"] == "finished", "the model")
    finished = values(status[-1])
    assert finished["last failure"] == "none" and float(finished["combined"]) > 0
    assert finished["report"] == str(models / "fresh.html")
    assert load_model(models / "fresh.safetensors").provenance["step"] == 300
    refused = client.call("/lifter/train")
    assert not refused.success and "set train.resume to false to begin one" in refused.message
    stream.assert_all_answered()


@pytest.mark.long
@pytest.mark.timeout(7200)
def test_many_kills_each_gone_on_with_end_in_the_model_of_a_training_left_alone(
    start_lifter: StartLifter,
    connect: Connect,
    models: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Half of the kills come anywhere, half of them within a second of a checkpoint."""
    (models / "broken.safetensors").unlink()
    lifter = start_lifter(
        SAVING_OFTEN,
        qos_overrides=EVERY_MESSAGE,
        train={"bags": [write(tmp_path / "bag")], "name": "alone", "steps": 2000, "seeds": 2,
               "screening": 100, "batch": 8, "activate": "never"},
    )  # fmt: skip
    client, moments, counts = connect(), random.Random(0), Counter[str]()
    stream, status = Stream(client), client.heard["/lifter/training_status"]

    def ended() -> bool:
        return bool(status) and values(status[-1])["state"] in ("failed", "finished")

    def saved() -> int:
        with suppress(FileNotFoundError):
            return checkpoint_file(models, "killed").stat().st_mtime_ns
        return 0

    def wait_until(moment: float) -> None:
        stream.until(lambda: ended() or time.monotonic() > moment, "the moment")

    def begin(name: str) -> None:
        found = read_record(models, name)
        counts["gone on with"] += bool(found)
        client.set_parameters(train__name=name, train__resume=found is not None)
        status.clear()
        answer = client.call("/lifter/train")
        assert answer.success, answer.message

    begin("alone")
    stream.until(ended, "the end", PATIENCE)
    alone = load_file(models / "alone.safetensors")
    while counts["killed"] < MANY_KILLS or read_record(models, "killed"):
        begin("killed")
        if counts["killed"] == MANY_KILLS:
            stream.until(ended, "the end", PATIENCE)
        elif moments.random() < 0.5:
            wait_until(time.monotonic() + moments.uniform(0, 8))
        else:
            before = saved()
            stream.until(lambda: ended() or saved() != before, "a checkpoint", PATIENCE)  # noqa: B023
            wait_until(time.monotonic() + moments.uniform(0, 1))
        if not ended():
            for pid in children_of(lifter.process.pid):
                os.kill(pid, signal.SIGKILL)
            stream.until(ended, "the end")
        state = values(status[-1])["state"]
        counts["killed" if state == "failed" else state] += 1
        assert state == "finished" or "SIGKILL" in status[-1].message
        for path in models.glob("*.safetensors"):
            load_model(path)
        if checkpoint_file(models, "killed").exists():
            read_checkpoint(checkpoint_file(models, "killed"))
            counts["checkpoints after a kill"] += 1
        if state == "finished":
            killed = load_file(models / "killed.safetensors")
            assert killed.keys() == alone.keys()
            for name, weight in alone.items():
                np.testing.assert_array_equal(killed[name], weight, name)
        with capsys.disabled():
            print(f"{dict(counts)}, messages sent: {stream.sent}", flush=True)
    stream.assert_all_answered()
    with capsys.disabled():
        print(f"messages answered: {stream.sent}", flush=True)
    assert counts["finished"]
    assert not [path.name for path in models.iterdir() if path.name.startswith(".killed.")]


def test_a_new_lifter_finds_what_was_cut_off(
    start_lifter: StartLifter, connect: Connect, models: Path, tmp_path: Path
) -> None:
    train = {"bags": [write(tmp_path / "bag")], "name": "fresh", "steps": 1000000, "seeds": 1}
    first = start_lifter(trains=True, train=train)
    client = connect()
    assert client.call("/lifter/train").success
    client.wait(lambda: recorded(models), "the record")
    (training,) = children_of(first.process.pid)
    for pid in (training, first.process.pid):  # as a power cut would
        os.kill(pid, signal.SIGKILL)
    first.process.wait()
    second = start_lifter()
    second.wait_for_log("unfinished training of 'fresh'")
    later = connect()
    status = later.wait_for_training("idle")
    for words in ("steps 1000000", f"bags {tmp_path / 'bag'}", "ago", "train.resume to true",
                  "ros2 run deep_nrsfm_ros train --resume --name fresh"):  # fmt: skip
        assert words in status.message and words in second.log
    assert values(status)["unfinished"] == "fresh"


@pytest.mark.parametrize("state", ["starting", "reading", "training"])
def test_a_training_can_be_cancelled_in_any_state(
    start_lifter: StartLifter, connect: Connect, models: Path, tmp_path: Path, state: str
) -> None:
    bag = write(tmp_path / "bag")
    train = {"bags": [bag], "name": "fresh", "steps": 1000000, "seeds": 1}
    # A forked training has left the first states before it can be cancelled in them.
    start_lifter(trains=state == "training", train=train)
    client = connect()
    assert client.call("/lifter/train").success
    if state != "starting":
        client.wait_for_training(state)
    second = client.call("/lifter/train")
    assert not second.success and "under way" in second.message
    if state == "training":
        assert float(values(client.wait_for_training("training"))["combined"]) > 0
    assert client.call("/lifter/cancel_training").success
    ended = client.wait_for_training("cancelled")
    assert ("train.resume to true" in ended.message) == (state == "training")
    assert (models / "fresh.safetensors").exists() == (state == "training")
    assert record_file(models, "fresh").exists() == (state == "training")


def test_data_that_cannot_be_trained_on_is_refused_with_advice(
    start_lifter: StartLifter, connect: Connect, models: Path, tmp_path: Path
) -> None:
    good = write(tmp_path / "bag")
    flat = write(tmp_path / "flat", flat=True)
    start_lifter(trains=True, train={"name": "fresh", "steps": 5, "seeds": 1, "batch": 8})
    client = connect()
    client.set_parameters(train__bags=[good], train__topic="/elsewhere")
    refused = client.call("/lifter/train")  # before the answer, not after it
    assert not refused.success
    assert "no topic called /elsewhere; its topics are: /keypoints" in refused.message
    file = tmp_path / "people.npy"  # a file is data too, without a bag
    np.save(file, np.concatenate((views(), np.ones((60, P, 1))), 2))
    for bags, inputs, complaint in [
        ([flat], [""], "a model cannot be learned from this: the views are flat"),
        ([""], [str(file)], ""),
    ]:
        client.set_parameters(train__bags=bags, train__inputs=inputs, train__topic="")
        client.set_parameters(train__min_change=0.0)
        client.heard["/lifter/training_status"].clear()
        assert client.call("/lifter/train").success
        if complaint:
            assert complaint in client.wait_for_training("failed").message
            client.heard["/diagnostics"].clear()
            # A report of before the failure may still be on its way.
            diagnosed = client.wait(
                lambda: [s for m in client.heard["/diagnostics"] for s in m.status
                         if s.name == "/lifter: training" and s.level == b"\x02"], "the diagnosis"
            )  # fmt: skip
            assert complaint in values(diagnosed[0])["last failure"]
        else:
            client.wait_for_training("finished")
    assert not record_file(models, "fresh").exists()


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_a_cut_bag_is_used_as_far_as_it_goes_and_the_loss_is_told(
    start_lifter: StartLifter, connect: Connect, models: Path, tmp_path: Path, storage: str
) -> None:
    bag = write(tmp_path / "bag", 4000 if storage == "mcap" else 400, storage)
    (file,) = (f for f in (tmp_path / "bag").iterdir() if f.suffix != ".yaml")
    os.truncate(file, int(0.8 * file.stat().st_size))
    lifter = start_lifter(
        trains=True, train={"bags": [bag], "name": "fresh", "steps": 5, "seeds": 1, "batch": 8}
    )
    client = connect()
    assert client.call("/lifter/train").success
    client.wait_for_training("finished")
    (warning,) = (line for line in lifter.log.splitlines() if "messages are lost" in line)
    assert warning.startswith("[WARN]") and "warning: bag " in warning
    assert "messages are lost" in (models / "fresh.html").read_text()
