# SPDX-License-Identifier: Apache-2.0
"""Training through the services of a lifter that goes on lifting."""

from __future__ import annotations

import dataclasses
import os
import shutil
import signal
import time
from array import array
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore
from std_msgs.msg import Float32MultiArray

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.model_files.model_file import Model, load_model, save_model
from deep_nrsfm_ros.node.training_service import check_keypoint_counts
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.training.config import DataConfig, TrainingConfig
from test.node.conftest import Connect, LifterProcess, StartLifter

P = 17
STAND_IN = (str(Path(__file__).with_name("lifter_with_stand_in_training.py")),)


def values(status: Any) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


def training_health(client: Any) -> Any:
    """Return the status of the training in the next diagnostics."""
    heard = client.heard["/diagnostics"]
    heard.clear()

    def found() -> Any:
        return next((s for m in heard for s in m.status if s.name == "/lifter: training"), None)

    return client.wait(found, "diagnostics of the training")


def keypoints(seed: int = 0, p: int = P) -> Float32MultiArray:
    points = np.random.default_rng(seed).uniform(50, 600, p * 2)
    return Float32MultiArray(data=array("f", points.astype(np.float32)))


def assert_ends(pid: int) -> None:
    """Assert that the process `pid` ends before long."""
    deadline = time.monotonic() + 60
    while Path(f"/proc/{pid}").exists():
        assert time.monotonic() < deadline, f"process {pid} is left behind"
        time.sleep(0.02)


@pytest.fixture
def lifter(start_lifter: StartLifter) -> LifterProcess:
    return start_lifter(STAND_IN, input_type="std_msgs/Float32MultiArray")


def test_a_training_from_request_to_use(
    lifter: LifterProcess, connect: Connect, models: Path
) -> None:
    shutil.copytree(models / "joints", models / "person")  # a bag
    client = connect()
    publisher = client.publisher(Float32MultiArray)
    assert values(client.wait_for_training("idle"))["state"] == "idle"
    refused = client.call("/lifter/train")
    assert not refused.success and "train.bags" in refused.message
    client.set_parameters(train__bags=[str(models / "nowhere")])
    assert "does not exist" in client.call("/lifter/train").message
    bag = models / "joints"
    assert client.set_parameters(train__bags=[str(bag)], train__name="../evil") == ""
    assert "../evil" in client.call("/lifter/train").message
    assert "Min: 1" in client.set_parameters(train__batch=0)
    assert not client.call("/lifter/cancel_training").success

    client.set_parameters(train__name="wait")
    accepted = client.call("/lifter/train")
    assert accepted.success, accepted.message
    training = values(client.wait_for_training("training"))
    assert (training["step"], training["steps"], training["loss"]) == ("1", "2", "0.5")
    second = client.call("/lifter/train")
    assert not second.success and "under way" in second.message
    assert client.exchange(publisher, keypoints()).width == P
    late = connect()
    assert values(late.wait_for_training("training"))["step"] == "1"
    assert client.call("/lifter/cancel_training").success
    assert "kept the best" in client.wait_for_training("cancelled").message

    client.set_parameters(train__name="doubtful")
    assert client.call("/lifter/train").success
    doubted = client.wait_for_training("finished")
    levels = {s.message: s.level for s in client.heard["/lifter/training_status"]}
    assert levels["warning: 60 frames are few"] == doubted.level == DiagnosticStatus.WARN
    assert "not in use" in doubted.message and values(doubted)["judgement"] == "doubtful"
    assert (models / "doubtful.safetensors").exists()
    client.heard["/lifter/training_status"].clear()

    client.set_parameters(train__name="finish")
    assert client.call("/lifter/train").success
    finished = client.wait_for_training("finished")
    assert (
        "not in use (train.activate): it is a model of 'cmu31', and the lifter lifts 'human17'"
        in (finished.message)
    )
    assert "to switch: ros2 param set /lifter model finish" in finished.message
    assert (models / "finish.safetensors").exists()
    client.wait_for_health(lambda _, v: v["model"] == "person")
    client.heard["/lifter/training_status"].clear()

    client.set_parameters(train__activate="always")
    assert client.call("/lifter/train").success
    switched = client.wait_for_training("finished").message
    client.wait_for_health(lambda _, v: v["model"] == "finish")
    said = (
        "in use from now on; a lifter that is started anew needs -p model:=finish; to go back to "
        "model 'person': ros2 param set /lifter model person"
    )
    assert switched.endswith(f"; {said}") and training_health(client).message == switched
    client.set_parameters(model="person")
    client.wait_for_health(lambda _, v: v["model"] == "person")
    assert training_health(client).message.endswith(
        "; was in use; the lifter has model 'person' now"
    )
    client.heard["/lifter/training_status"].clear()

    client.set_parameters(train__bags=[str(models / "person")])
    client.set_parameters(train__activate="if_better", train__name="other")  # of the same object
    client.heard["/lifter/training_status"].clear()
    assert client.call("/lifter/train").success
    assert "; in use from now on; " in client.wait_for_training("finished").message
    client.wait_for_health(lambda _, v: v["model"] == "other")
    client.heard["/lifter/training_status"].clear()
    (models / "other_before.safetensors").write_bytes((models / "other.safetensors").read_bytes())
    assert client.call("/lifter/train").success
    assert client.wait_for_training("finished").message.endswith("model other_before")


@pytest.mark.parametrize("judgement", ["as_good", "alone"])
def test_every_model_that_is_not_doubtful_is_used(
    lifter: LifterProcess, connect: Connect, models: Path, judgement: str
) -> None:
    shutil.copytree(models / "joints", models / "person")  # a bag
    client = connect()
    client.set_parameters(train__bags=[str(models / "person")], train__name=judgement)
    assert client.call("/lifter/train").success
    finished = client.wait_for_training("finished")
    assert values(finished)["judgement"] == judgement and "in use from now on" in finished.message
    assert finished.level == DiagnosticStatus.OK


def test_the_way_to_a_model_of_another_object_is_one_that_works(
    lifter: LifterProcess, connect: Connect, models: Path
) -> None:
    client = connect()
    assert client.set_parameters(keypoint_layout="coco17") == ""
    client.set_parameters(train__bags=[str(models / "joints")], train__name="finish")
    assert client.call("/lifter/train").success
    how = client.wait_for_training("finished").message.split("to switch: ")[1]
    assert how == (
        "ros2 param set /lifter keypoint_layout model, and then ros2 param set /lifter model finish"
    )
    for command in how.split(", and then "):
        name, value = command.split()[-2:]
        assert client.set_parameters(**{name: value}) == ""
    client.wait_for_health(lambda _, v: v["model"] == "finish")


def test_a_training_that_fails_leaves_the_lifter_as_it_was(
    lifter: LifterProcess, connect: Connect, models: Path
) -> None:
    client = connect()
    publisher = client.publisher(Float32MultiArray)
    client.set_parameters(train__bags=[str(models / "broken")])
    for name, state, reason in [
        ("crash", "failed", "the dictionary caught fire"),
        ("refuse", "failed", "/nowhere is not in the bag"),
        ("finish", "finished", "not in use: "),  # a damaged model
    ]:
        client.set_parameters(train__name=name)
        client.heard["/lifter/training_status"].clear()
        assert client.call("/lifter/train").success
        status = client.wait_for_training(state)
        assert reason in status.message
        assert status.level == (b"\x02" if state == "failed" else b"\x00")
        assert client.exchange(publisher, keypoints()).width == P
    client.wait_for_health(lambda _, v: v["model"] == "person")


@pytest.mark.parametrize(
    ("number", "behaviour"), [(signal.SIGINT, "wait"), (signal.SIGTERM, "deaf")]
)
def test_signals_end_lifter_and_training(
    lifter: LifterProcess, connect: Connect, models: Path, number: signal.Signals, behaviour: str
) -> None:
    client = connect()
    bag = str(models / "joints")
    client.set_parameters(train__bags=[bag], train__name=behaviour)
    assert client.call("/lifter/train").success
    training = int(values(client.wait_for_training("training"))["session"])
    code = lifter.stop(number, f"while a training runs that is {behaviour}")
    assert code == 0 and "Traceback" not in lifter.log, lifter.log
    assert_ends(training)


def test_a_killed_lifter_leaves_no_training_behind(
    lifter: LifterProcess, connect: Connect, models: Path
) -> None:
    client = connect()
    client.set_parameters(train__bags=[str(models / "joints")], train__name="wait")
    assert client.call("/lifter/train").success
    training = int(values(client.wait_for_training("training"))["session"])
    os.kill(lifter.process.pid, signal.SIGKILL)
    lifter.process.wait()
    assert_ends(training)


def write_bag(path: Path, frames: int, p: int = P) -> None:
    """Write a bag of 2D keypoints of a deforming object seen by random cameras."""
    types, rng = get_typestore(Stores.ROS2_JAZZY), np.random.default_rng(0)
    array_type = types.types["std_msgs/msg/Float32MultiArray"]
    layout_type = types.types["std_msgs/msg/MultiArrayLayout"]
    size_type = types.types["std_msgs/msg/MultiArrayDimension"]
    basis = rng.standard_normal((3, p, 3))
    with Writer(path, version=9) as bag:
        topic = bag.add_connection("/keypoints", array_type.__msgtype__, typestore=types)
        for i in range(frames):
            shape = np.tensordot(rng.uniform(0.5, 1, 3), basis, 1)
            camera = np.linalg.qr(rng.standard_normal((3, 3)))[0][:, :2]
            data = (300 + 100 * shape @ camera).astype(np.float32).ravel()
            sizes = [size_type("", size, 0) for size in (p, 2)]
            message = array_type(layout_type(sizes, 0), data)
            bag.write(topic, i * 10**7, types.serialize_cdr(message, array_type.__msgtype__))


def test_the_real_training_turns_a_bag_into_the_model_in_use(
    start_lifter: StartLifter, connect: Connect, models: Path, tmp_path: Path
) -> None:
    write_bag(tmp_path / "bag", 200)
    lifter = start_lifter(
        input_type="std_msgs/Float32MultiArray",
        train={"bags": [str(tmp_path / "bag")], "name": "fresh", "steps": 20, "activate": "always"},
    )
    client = connect()
    publisher = client.publisher(Float32MultiArray)
    before = client.exchange(publisher, keypoints()).data
    accepted = client.call("/lifter/train")
    assert accepted.success, accepted.message
    assert "starting from model 'person'" in accepted.message
    finished = client.wait_for_training("finished")
    assert "in use from now on" in finished.message
    said = [s.message for s in client.heard["/lifter/training_status"]]
    assert any("train.held_out" in text for text in said) and not [s for s in said if "--" in s]
    assert values(finished)["judgement"] in ("better", "as_good", "doubtful")
    assert load_model(models / "fresh.safetensors").name == "fresh"
    client.wait_for_health(lambda _, v: v["model"] == "fresh")
    assert client.exchange(publisher, keypoints()).data != before
    assert "torch" not in Path(f"/proc/{lifter.process.pid}/maps").read_text()


def test_bags_of_another_number_of_keypoints_are_refused_at_once(
    lifter: LifterProcess, connect: Connect, models: Path, tmp_path: Path
) -> None:
    write_bag(tmp_path / "fingers", 20, 21)
    client = connect()
    client.set_parameters(train__bags=[str(tmp_path / "fingers")], train__name="finish")
    refused = client.call("/lifter/train")
    assert not refused.success
    assert "fingers: message has 21 keypoints" in refused.message
    assert "set train.keypoint_layout, which stands for 'human17' now" in refused.message
    # A bag that fits is enough: the training leaves out the messages of the other, and counts them.
    both = (tmp_path / "fingers", models / "joints")
    check_keypoint_counts(TrainingConfig(DataConfig(both), object="human17"))
    # Where no layout is named the training finds it: 17 keypoints may be coco17.
    write_bag(tmp_path / "people", 20, 17)
    people = DataConfig((tmp_path / "people",))
    check_keypoint_counts(TrainingConfig(people, object="human25"))
    named = dataclasses.replace(people, keypoint_layout="human25")
    with pytest.raises(ValueError, match="17 keypoints"):
        check_keypoint_counts(TrainingConfig(named, object="human25"))


PAW = KeypointLayout("paw", ("heel", "toe_1", "toe_2", "toe_3", "toe_4"))


def test_an_object_that_is_no_preset_is_trained_by_number_and_its_model_is_used(
    start_lifter: StartLifter, connect: Connect, models: Path, tmp_path: Path
) -> None:
    write_bag(tmp_path / "bag", 200, len(PAW))
    network = initialise(Architecture(widths=(8, 4)), len(PAW), np.random.default_rng(0))
    paw = Model("paw", network, PAW, Normaliser(), np.eye(3, dtype=np.float32))
    save_model(models / "paw.safetensors", paw)
    train: dict[str, Any] = {"bags": [str(tmp_path / "bag")], "topic": "/keypoints"}
    train |= {"name": "counted", "steps": 1, "seeds": 1, "activate": "always", "from": "nobody"}
    start_lifter(trains=True, input_type="std_msgs/Float32MultiArray", model="paw", train=train)
    client = connect()
    publisher = client.publisher(Float32MultiArray)
    before = client.exchange(publisher, keypoints(p=len(PAW))).data
    refused = client.call("/lifter/train")
    assert not refused.success and "no model 'nobody'; there are" in refused.message

    client.set_parameters(train__from="", train__object="numbered")
    accepted = client.call("/lifter/train")
    assert accepted.success and "no handedness: depth may come out mirrored" in accepted.message
    assert "in use from now on" in client.wait_for_training("finished").message
    client.wait_for_health(lambda _, v: v["model"] == "counted")
    counted = load_model(models / "counted.safetensors")
    assert counted.layout == KeypointLayout.numbered(len(PAW)) and "from" not in counted.provenance
    assert client.set_parameters(model="paw") == ""
    assert client.exchange(publisher, keypoints(p=len(PAW))).data == before
