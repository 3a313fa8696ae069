# SPDX-License-Identifier: Apache-2.0
"""Commands of the README and the documentation are run as they stand, with short inputs.

A training takes one step. The lifter is started in this process with the arguments of the command,
and waits for messages. `NOT_RUN` has the commands that are not run here, and why.
"""

from __future__ import annotations

import importlib.util
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rclpy

from deep_nrsfm_ros.commands import demo, lift, models, replay, train
from deep_nrsfm_ros.commands.demo.first_look import write_keypoints
from deep_nrsfm_ros.data.bags import Frame, write_bag
from deep_nrsfm_ros.data.clip import read_clip
from deep_nrsfm_ros.data.virtual_hands import virtual_hands
from deep_nrsfm_ros.layouts.presets import BODY25B, COCO17
from deep_nrsfm_ros.model_files.model_file import load_model, save_model
from deep_nrsfm_ros.node.lifter import LifterNode
from docs.generate import parameter_names
from test.node.conftest import own_domain
from test.test_documented_commands import COMMANDS, PAGES, ROOT

PROGRAMS = {
    program.__name__.rsplit(".", 1)[1]: program.main
    for program in (demo, lift, models, replay, train)
}
NOT_RUN = {
    r"train .*--cmu|evaluate .*--cmu": "needs motion capture of CMU; takes minutes to hours",
    r"evaluate .*--pose2sim": "needs a download; test/commands/test_evaluate.py has a session",
    r"train .*--(mapping|image-width)": "needs the bag of a detector; test/data/test_bags.py",
    r"train .*door.yaml": "that of README.md with another name",
    r"train --resume": "needs a training that was cut off; test/training/test_resume.py",
    r"replay --serve": "serves until Ctrl-C; test/commands/test_replay.py, test_lifter_client.py",
    r"echo": "prints until Ctrl-C; test/node/test_points_text.py",
    r"doctor": "starts two processes; test/commands/test_doctor.py",
    r"demo": "test/commands/test_demo.py",
    r"lifter .*--enclave": "needs a keystore; test/node/test_security_policy.py",
    r"lifter .*target_frame:=base_link$": "needs tf2_msgs of ROS; test/node/test_target_frame.py",
    r"lifter .*ros2 pkg": "needs a detector's package; test/messages/test_field_mapping.py",
    r"mediapipe_detector": "needs MediaPipe; test/examples/test_mediapipe_detector.py",
}
TESTS = sorted({name for why in NOT_RUN.values() for name in re.findall(r"test/[\w/]+\.py", why)})
CALLS = {(name, *words): (name, words) for _, name, words in COMMANDS}
RUN = {
    " ".join(call): command
    for call, command in CALLS.items()
    if not any(re.match(pattern, " ".join(call)) for pattern in NOT_RUN)
}
FILES = {text: call for text, call in RUN.items() if call[0] != "lifter"}
LIFTERS = {text: words for text, (name, words) in RUN.items() if name == "lifter"}
LINES = sorted(
    {
        line.strip()
        for page in PAGES
        for line in re.findall(r"^ {4,}(?!\|)(.*)$", page.read_text("utf-8"), re.MULTILINE)
    }
)
MODELS = Path("ros/deep_nrsfm_ros/models")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that the commands name."""
    folder = tmp_path_factory.mktemp("documented")
    view = read_clip().session.views[0]
    people = np.dstack([view.points, view.confidence])[:40]
    (folder / "people.json").write_text(str(people.tolist()))
    hands = virtual_hands(60).points + np.float32(300)
    np.savez(folder / "hands.npz", points=hands)
    order = [BODY25B.keypoints.index(name) for name in COCO17.keypoints]
    for name, q in (("coco17", order), ("body25", list(range(25)))):
        (folder / name).mkdir()
        frames = (
            Frame(10**9 + 33_000_000 * i, view.points[i : i + 1, q], view.confidence[i : i + 1, q])
            for i in range(40)
        )
        write_bag(folder / name / "my_bag", "/keypoints", frames, "mcap")
    names = ", ".join(COCO17.keypoints)
    (folder / "coco17" / "dog.yaml").write_text(
        f"name: dog\nkeypoints: [{names}]\nedges: [[left_hip, left_knee]]\n"
        "handedness: {left: left_hip, right: right_hip, up: nose, front: left_knee}\n"
    )
    write_keypoints(read_clip(), folder / "demo_output")
    models = folder / MODELS
    models.mkdir(parents=True)
    for name in ("first", "mine"):  # that an earlier command of the page has trained
        save_model(models / f"{name}.safetensors", load_model("human"))
    return folder


@pytest.fixture(scope="module")
def nodes() -> Iterator[None]:
    with own_domain():
        yield


@pytest.mark.parametrize("command", FILES)
def test_a_documented_command_runs(
    folder: Path, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, words = FILES[command]
    words = [word.replace("~", str(folder)) for word in words]
    more = {"train": ["--steps", "1"], "lift": ["--models-dir", str(folder / MODELS)]}.get(name, [])
    bag = "body25" if "body25" in words else "coco17"
    monkeypatch.setenv("ROS_HOME", str(folder / "ros"))
    monkeypatch.chdir(folder / bag if "my_bag" in words else folder)
    PROGRAMS[name]([*words, *more])
    for option in ("--output", "--html"):
        if option in words:
            assert Path(words[words.index(option) + 1]).exists()


@pytest.mark.usefixtures("nodes")
@pytest.mark.parametrize("command", LIFTERS)
def test_a_documented_lifter_starts(folder: Path, command: str) -> None:
    words = [word.replace("$PWD", str(ROOT)) for word in LIFTERS[command]]
    if "model:=mine" in words:
        words += ["-p", f"models_dir:={folder / MODELS}"]
    rclpy.init(args=words)
    try:
        node = LifterNode()
        given = dict(re.findall(r"-p ([\w.]+):=(\S+)", command))
        assert all(node.has_parameter(name) for name in given)
        node.close()
        node.destroy_node()
    finally:
        rclpy.shutdown()


def test_each_command_that_is_not_run_has_a_reason_that_holds() -> None:
    names = [" ".join(call) for call in CALLS]
    assert all(any(re.match(pattern, name) for name in names) for pattern in NOT_RUN)
    assert all((ROOT / path).exists() for path in TESTS)
    assert len(FILES) >= 7 and len(LIFTERS) >= 12


def test_parameters_that_are_set_exist() -> None:
    names = {shlex.split(line)[4] for line in LINES if line.startswith("ros2 param set /lifter ")}
    assert len(names) > 4 and names <= set(parameter_names())


def test_modules_and_examples_exist() -> None:
    modules = {line.split()[2] for line in LINES if line.startswith("python -m ")}
    files = {line.split()[1] for line in LINES if line.startswith("python examples/")}
    assert len(modules) > 20 and len(files) > 2
    assert [name for name in modules if importlib.util.find_spec(name) is None] == []
    assert [name for name in files if not (ROOT / name).exists()] == []


def test_launch_files_and_targets_of_make_exist() -> None:
    launched = {line.split()[3] for line in LINES if line.startswith("ros2 launch deep_nrsfm_ros ")}
    assert len(launched) == 3 and all((ROOT / "launch" / name).exists() for name in launched)
    targets = {line.split()[1] for line in LINES if line.startswith("make ")}
    makefile = (ROOT / "Makefile").read_text("utf-8")
    assert len(targets) > 2 and all(f"\n{name}:" in makefile for name in targets)


def test_extras_exist() -> None:
    extras = {e for line in LINES for e in re.findall(r"pip install '[\w.]+\[([\w,-]+)\]'", line)}
    setup = (ROOT / "setup.py").read_text("utf-8")
    names = {name for group in extras for name in group.split(",")}
    assert len(names) > 1 and all(f'        "{name}": [' in setup for name in names)
