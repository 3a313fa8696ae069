# SPDX-License-Identifier: Apache-2.0
"""The training program as others start it: a bag in, progress as JSON lines, a model out."""

from __future__ import annotations

import dataclasses
import html
import json
import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.data.walking_person import in_layout
from deep_nrsfm_ros.commands import train
from deep_nrsfm_ros.data.bags import frames, write_bag
from deep_nrsfm_ros.data.clip import read_clip
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.layout_file import read_layout
from deep_nrsfm_ros.layouts.presets import BODY25B, COCO17, HUMAN25
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.lifting.sanity import EXIT_DOUBTFUL
from deep_nrsfm_ros.model_files.model_file import Model, load_model, save_model
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras
from deep_nrsfm_ros.training import judge, run
from deep_nrsfm_ros.training.config import TrainingConfig
from deep_nrsfm_ros.training.record import find_records, read_record
from deep_nrsfm_ros.training.trainer import Trainer
from test.fixtures.forked_python import TRAINING, ForkedPython
from test.fixtures.training_program import RunTraining

DEADLINE = 90.0
FORCE = "--force"  # the people made up here fit no model of people
QUICK = ("--widths", "8", "4", "--batch", "8", "--threads", "1", "--name", "mine", FORCE)
SUFFIXES = (".html", ".safetensors")
ENDLESS = ("--steps", "1000000")


def people(f: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Return what a detector saw of people of COCO17: pixels (f, 17, 2) and confidence."""
    rng = np.random.default_rng(0)
    shapes = centre(rng.standard_normal((17, 3)) + 0.3 * rng.standard_normal((f, 17, 3)))
    points = 100 * (shapes @ random_cameras(f, rng)) + [320, 240]
    return points.astype(np.float32), np.full((f, 17), 0.9, np.float32)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A bag of COCO17 keypoints."""
    write_bag(tmp_path / "bag", "/keypoints", frames(*people()))
    return tmp_path / "bag"


@pytest.fixture
def models(tmp_path: Path) -> Path:
    return tmp_path / "models"


@pytest.fixture
def arguments(bag: Path, models: Path) -> list[str]:
    """Arguments of a training that takes no time."""
    source = ("--bag", str(bag), "--topic", "/keypoints", "--keypoint-layout", "coco17")
    return [*source, "--output", str(models), *QUICK]


@pytest.fixture
def start() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start the program with JSON progress; its standard input stays open."""
    started: list[subprocess.Popen[str]] = []

    def run(*words: str, launcher: tuple[str, ...] = ()) -> subprocess.Popen[str]:
        command = (*launcher, "-m", "deep_nrsfm_ros.commands.train", *words, "--json-progress")
        pipes: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        process = ForkedPython(command, TRAINING, forks=bool(launcher), **pipes)
        started.append(process)
        return process

    yield run
    for process in started:
        with process:  # closes its pipes
            process.kill()


def test_two_processes_write_one_model(
    arguments: list[str], models: Path, start: Callable[..., subprocess.Popen[str]]
) -> None:
    launcher = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2")
    lines = finish(start(*arguments, "--steps", "20", launcher=launcher))
    assert [line["state"] for line in lines].count("finished") == 1
    model = assert_lifts(models / "mine.safetensors")
    assert model.provenance["frames"] == 60 and model.provenance["processes"] == 2
    assert sorted(f.name for f in models.iterdir()) == ["mine.html", "mine.safetensors"]


def wait_for_training(process: subprocess.Popen[str]) -> list[dict[str, Any]]:
    """Read lines until one says that training goes on; return them parsed."""
    lines = []
    for line in process.stdout or ():
        lines.append(json.loads(line))
        if lines[-1]["state"] == "training":
            return lines
    pytest.fail(f"no training: {lines} {process.communicate()[1]}")


def finish(process: subprocess.Popen[str]) -> list[dict[str, Any]]:
    """Return the remaining lines of a process that ends by itself, parsed."""
    lines = [json.loads(line) for line in process.stdout or ()]
    process.wait(DEADLINE)
    return lines


def assert_lifts(path: Path) -> Model:
    model = load_model(path)
    points = np.random.default_rng(1).uniform(0, 500, (3, len(model.layout), 2))
    lifted = Lifter(model)(points.astype(np.float32), np.ones(points.shape[:2], np.float32))
    assert np.isfinite(lifted.shapes).all() and lifted.shapes.any()
    return model


def test_from_bag_to_model(
    arguments: list[str],
    models: Path,
    in_process: RunTraining,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = (*arguments, "--steps", "30", "--seeds", "2", "--screening", "5", "--json-progress")
    assert in_process(*words) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    states = [line["state"] for line in lines]
    order = ["reading", "curating", "training", "judging", "finished"]
    assert states[-1] == "finished" and [*dict.fromkeys(states)] == [
        s for s in order if s in states
    ]
    judging = [line["message"] for line in lines if line["state"] == "judging"]
    assert sum(text.startswith("judging: ") for text in judging) == 3
    progress = [line for line in lines if line["state"] == "training" and "step" in line]
    assert (progress[-1]["step"], progress[-1]["steps"]) == (30, 30)
    for field in ("loss", "cycle_error", "coherence", "seconds_left"):
        assert isinstance(progress[-1][field], float)
    assert any("60 frames of 25 keypoints (bags bag)" in line.get("message", "") for line in lines)
    path = models / "mine.safetensors"
    assert lines[-1]["model"] == str(path) and str(path) in lines[-1]["message"]
    assert lines[-1]["report"] == str(models / "mine.html")
    model = assert_lifts(path)
    assert (model.name, model.layout) == ("mine", HUMAN25)
    assert model.network.architecture.widths == (8, 4)
    assert model.provenance["recipe"]["steps"] == 30 and model.provenance["step"] == 30
    assert lines[-1]["cycle_error"] == model.quality["cycle_error"]
    assert sorted(f.name for f in models.iterdir()) == ["mine.html", "mine.safetensors"]


def test_people_read_verdict_file_and_how_to_use_it_in_short_lines(
    tmp_path: Path, models: Path, in_process: RunTraining, capsys: pytest.CaptureFixture[str]
) -> None:
    views = [np.dstack((view.points, view.confidence)) for view in read_clip().session.views]
    np.save(tmp_path / "people.npy", np.concatenate(views))
    words = ("--input", str(tmp_path / "people.npy"), "--keypoint-layout", "body25b")
    assert in_process(*words, "--output", str(models), *QUICK, "--steps", "5") == 0
    said = capsys.readouterr()
    shared_out = next(line for line in said.err.splitlines() if "are trained on;" in line)
    assert "later ones are held out to judge the model" in shared_out
    verdict, figures, file, report, use, truth = said.out.strip().splitlines()
    assert verdict.startswith("finished: the new model is doubtful: ") and len(verdict) < 700
    assert figures.startswith("  judged beside model 'human' on ") and len(figures) < 400
    assert file == f"  model {models / 'mine.safetensors'}" and report.startswith("  report ")
    assert "not in use, but you can look at what it lifts: lift FILE --model" in use
    assert "ros2 param set /lifter model" in use
    path = models / "mine.safetensors"
    assert truth == f"  see how many mm it is off on the demo's person: demo --model {path}"
    assert "{" not in said.out and "the new model is doubtful" not in said.err


def test_keypoints_that_no_frame_shows_stay_guesses_of_the_start(
    tmp_path: Path, models: Path, in_process: RunTraining, capsys: pytest.CaptureFixture[str]
) -> None:
    view = read_clip().session.views[0]
    feet = [k for k, name in enumerate(BODY25B.keypoints) if "toe" in name or "heel" in name]
    confidence = view.confidence.copy()
    confidence[:, feet] = 0
    np.save(tmp_path / "people.npy", np.dstack((view.points, confidence)))
    words = ("--input", str(tmp_path / "people.npy"), "--keypoint-layout", "body25b")
    more = ("--object", "human25", "--steps", "1", "--threads", "1", "--name", "mine")
    assert in_process(*words, *more, "--output", str(models)) == 0
    said = capsys.readouterr()
    assert "right_heel" in said.err and "will only guess them, as 'human' does" in said.err
    assert "Rarely shown: " in said.out
    assert "(guessed mostly as the start does; --start-share 0.8 keeps more of that)" in said.out
    kept, human = load_model(models / "mine.safetensors"), load_model("human")
    np.testing.assert_array_equal(kept.error_covariance, human.error_covariance)


def test_hands_of_both_sides_are_doubtful_unless_their_side_is_said(
    tmp_path: Path, models: Path, in_process: RunTraining, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    shapes = centre(rng.standard_normal((21, 3)) + 0.3 * rng.standard_normal((300, 21, 3)))
    np.save(tmp_path / "hands.npy", 100 * (shapes @ random_cameras(300, rng)) + [320, 240])
    words = ("--input", str(tmp_path / "hands.npy"), "--object", "hand21", "--steps", "5")
    quick = [word for word in QUICK if word != FORCE]
    said = {}
    for side, code in (("", EXIT_DOUBTFUL), ("palms", 0)):
        more = ("--hands", side) if side else ()
        assert in_process(*words, *more, "--output", str(models), *quick) == code
        said[side] = capsys.readouterr()
    assert "look like those of the other side" in said[""].err
    assert said[""].out.startswith("finished: the new model is doubtful: its data looks wrong: 4")
    assert "look like those of the other side" not in said["palms"].err + said["palms"].out


@pytest.mark.parametrize("how", ["SIGTERM", "end of standard input"])
def test_cancelling_keeps_what_was_learned(
    arguments: list[str], models: Path, start: Callable[..., subprocess.Popen[str]], how: str
) -> None:
    process = start(*arguments, *ENDLESS)
    wait_for_training(process)
    before = time.monotonic()
    if how == "SIGTERM":
        process.send_signal(signal.SIGTERM)
    else:
        assert process.stdin is not None
        process.stdin.close()
    lines = finish(process)
    assert time.monotonic() - before < 20
    assert process.returncode == train.CANCELLED == 130
    assert lines[-1]["state"] == "cancelled" and "learned so far" in lines[-1]["message"]
    assert lines[-1]["model"] == str(models / "mine.safetensors")
    assert 0 < assert_lifts(models / "mine.safetensors").provenance["step"] < 1000000


def stop_after(steps: int) -> Callable[[], Callable[[], bool]]:
    """Stop after so many steps, or in the curation (-1)."""
    calls = iter(range(10**6))
    before = 1 + 2  # once after reading, and once in each pass of the curation
    return lambda: lambda: next(calls) >= before + steps


def test_resume_goes_on_where_it_was_cancelled(
    arguments: list[str],
    models: Path,
    in_process: RunTraining,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = [*arguments, "--steps", "12", "--seeds", "1"]
    assert in_process(*words) == 0
    whole = dict(load_model(models / "mine.safetensors").network.named_weights())
    with monkeypatch.context() as cancelled:
        cancelled.setattr(train, "stop_on_signals", stop_after(5))
        assert in_process(*words) == 130
    assert load_model(models / "mine.safetensors").provenance["step"] == 5
    assert "starts from" in capsys.readouterr().err
    taken: list[int] = []
    advance = Trainer.advance
    monkeypatch.setattr(Trainer, "advance", lambda t: (taken.append(t.step), advance(t)))
    assert in_process(*words, "--resume") == 0
    assert taken == list(range(5, 12))
    for name, weight in load_model(models / "mine.safetensors").network.named_weights():
        np.testing.assert_array_equal(weight, whole[name])
    said = capsys.readouterr().err
    assert "goes on at step 5 of 12" in said and "starts from" not in said
    names = [f"{name}{suffix}" for name in ("mine", "mine_before") for suffix in SUFFIXES]
    assert sorted(f.name for f in models.iterdir()) == names
    assert load_model(models / "mine_before.safetensors").provenance["step"] == 12  # the first one


def test_the_curation_can_be_stopped(
    arguments: list[str],
    models: Path,
    in_process: RunTraining,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(train, "stop_on_signals", stop_after(-1))
    assert in_process(*arguments) == 130
    assert "cancelled: nothing had been learned" in capsys.readouterr().out
    assert not list(models.glob("*"))


@pytest.mark.parametrize("unusable", ["dark file", "dark bag", "unreadable bag"])
def test_data_that_nobody_can_train_on_does_not_turn_a_stop_into_a_failure(
    unusable: str,
    tmp_path: Path,
    models: Path,
    in_process: RunTraining,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    points, confidence = people()
    path = tmp_path / "data.npz" if unusable == "dark file" else tmp_path / "data"
    layout = "body25" if unusable == "unreadable bag" else "coco17"
    if unusable == "dark file":  # no progress is reported while it is read
        np.savez(path, points=points, confidence=0 * confidence)
    else:
        write_bag(path, "/keypoints", frames(points, confidence * (layout == "body25")))
    option = "--input" if unusable == "dark file" else "--bag"
    words = (option, str(path), "--keypoint-layout", layout, "--output", str(models))
    assert in_process(*words, *QUICK, "--json-progress") == 2
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["state"] == "failed"
    monkeypatch.setattr(train, "stop_on_signals", lambda: lambda: True)
    assert in_process(*words, *QUICK, "--json-progress") == 130
    (*_, end) = map(json.loads, capsys.readouterr().out.splitlines())
    assert end["state"] == "cancelled" and "nothing had been learned" in end["message"]
    assert not list(models.glob("*"))


def test_without_resume_it_begins_anew(
    arguments: list[str],
    models: Path,
    in_process: RunTraining,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with monkeypatch.context() as cancelled:
        cancelled.setattr(train, "stop_on_signals", stop_after(4))
        assert in_process(*arguments, "--steps", "12", "--seeds", "1") == 130
        cancelled.setattr(train, "stop_on_signals", stop_after(0))
        assert in_process(*arguments, "--steps", "3") == 130  # before anything is learned
    said = capsys.readouterr().err
    assert "'mine' begins anew. The unfinished one is kept as 'mine_unfinished'" in said
    assert "--resume --name mine_unfinished goes on with it" in said
    record = read_record(models, "mine_unfinished")
    assert record and record.saved and record.config and record.config.recipe.steps == 12
    resume = ("--resume", "--name", "mine_unfinished", "--output", str(models), "--threads", "1")
    with monkeypatch.context() as cancelled:
        cancelled.setattr(train, "stop_on_signals", stop_after(2))
        assert in_process(*resume) == 130
    assert "goes on at step 4 of 12" in capsys.readouterr().err
    # A checkpoint of another architecture would be refused, were it read.
    assert in_process(*arguments, "--steps", "3", "--widths", "6", "3") == 0
    model = load_model(models / "mine.safetensors")
    assert model.provenance["step"] == 3 and model.network.architecture.widths == (6, 3)
    assert load_model(models / "mine.safetensors").provenance["judgement"]["doubtful"]
    assert read_record(models, "mine_unfinished")  # it may be the better one


def test_time_ends_a_training(
    arguments: list[str],
    models: Path,
    in_process: RunTraining,
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = time.monotonic()
    assert in_process(*arguments, *ENDLESS, "--minutes", "0.02") == 0
    assert time.monotonic() - before < 30
    said = capsys.readouterr().out
    assert "finished" in said and "of 1000000 steps its time was up" in said
    assert_lifts(models / "mine.safetensors")
    assert sorted(f.name for f in models.iterdir()) == ["mine.html", "mine.safetensors"]


def test_a_cancelled_screening_keeps_a_model_and_goes_on(
    arguments: list[str],
    models: Path,
    in_process: RunTraining,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = [*arguments, "--steps", "50", "--seeds", "3"]
    assert in_process(*words) == 0
    whole = load_model(models / "mine.safetensors")
    capsys.readouterr()
    with monkeypatch.context() as cancelled:
        cancelled.setattr(train, "stop_on_signals", stop_after(6))
        assert in_process(*words) == 130
    assert "--resume --name mine goes on" in capsys.readouterr().out
    assert assert_lifts(models / "mine.safetensors").provenance["step"] == 5
    assert in_process(*words, "--resume") == 0
    assert "is screened" in capsys.readouterr().err
    again = load_model(models / "mine.safetensors")
    assert again.provenance["seed"] == whole.provenance["seed"] and again.quality == whole.quality


BAD: dict[str, tuple[list[str], str]] = {
    "no data": ([], "--bag"),
    "both kinds of data": (["--bag", "BAG", "--cmu", "FOLDER"], "--bag"),
    "absent bag": (["--bag", "FOLDER/absent"], "absent"),
    "absent topic": (["--bag", "BAG", "--topic", "/poses"], "/poses"),
    "absent subject": (["--cmu", "FOLDER", "--subjects", "99"], "99"),
    "wrong layout": (["--bag", "BAG", "--keypoint-layout", "body25"], "17"),
    "layouts that share nothing": (
        ["--bag", "BAG", "--keypoint-layout", "coco17", "--object", "cmu31"],
        "at least 4",
    ),
    "the layout of another object": (
        ["--bag", "BAG", "--keypoint-layout", "coco17", "--object", "cmu31"],
        "; set --keypoint-layout to the layout of the recorded keypoints, for which 'coco17' is "
        "taken now, or --object",
    ),
    "unknown object": (["--bag", "BAG", "--object", "horse"], "--object is 'horse'; name a preset"),
    "unknown layout": (
        ["--bag", "BAG", "--keypoint-layout", "horse"],
        "--keypoint-layout is 'horse'; name a preset",
    ),
    "absent layout file": (["--bag", "BAG", "--object", "FOLDER/a.yaml"], "a.yaml: cannot be read"),
    "numbered with names": (
        ["--bag", "BAG", "--object", "numbered", "--keypoint-layout", "coco17"],
        "leave out --keypoint-layout",
    ),
    "numbered motion capture": (
        ["--cmu", "FOLDER", "--object", "numbered"],
        "--object is 'numbered', which takes the points of bags",
    ),
    "absent start": (["--bag", "BAG", "--from", "nowhere"], "no model 'nowhere'; there are"),
    "start of another shape": (
        ["--bag", "BAG", "--from", "human", "--widths", "8"],
        "--widths is (8,); model 'human', from which to start, has",
    ),
    "start of another object": (
        ["--bag", "BAG", "--from", "cmu31", "--object", "coco17"],
        "share 0 keypoints by name",
    ),
    "out of range": (["--bag", "BAG", "--learning-rate", "7"], "--learning-rate is 7.0"),
    "name of a model of the package": (
        ["--bag", "BAG", "--name", "human"],
        "--name is 'human', the name of a model that comes with the package and that yours would "
        "hide; choose another, such as 'my_human'",
    ),
    "no dictionary": (["--bag", "BAG", "--widths"], "widths"),
    "output is a file": (
        ["--bag", "BAG", "--keypoint-layout", "coco17", "--output", "FOLDER/file"],
        "file",
    ),
}


@pytest.mark.parametrize(("words", "complaint"), BAD.values(), ids=BAD)
def test_bad_input_is_named_and_ends_with_2(
    words: list[str],
    complaint: str,
    bag: Path,
    in_process: RunTraining,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    (tmp_path / "file").touch()
    places = {"BAG": str(bag), "FOLDER": str(tmp_path)}
    for name, place in places.items():
        words = [word.replace(name, place) for word in words]
    output = () if "--output" in words else ("--output", str(tmp_path / "models"))
    assert in_process("--steps", "1", *output, *words) == 2
    errors = capsys.readouterr().err
    assert "failed: " in errors and complaint in errors
    assert not list(tmp_path.glob("models/*"))


@pytest.mark.parametrize("words", [("--steps", "many"), ("--unknown",)])
def test_a_wrong_command_line_ends_with_2(
    words: tuple[str, ...], in_process: RunTraining, capsys: pytest.CaptureFixture[str]
) -> None:
    assert in_process(*words) == 2
    assert words[0] in capsys.readouterr().err


def test_failing_is_a_line_of_json_too(
    in_process: RunTraining, capsys: pytest.CaptureFixture[str]
) -> None:
    assert in_process("--bag", "absent", "--json-progress") == 2
    (line,) = map(json.loads, capsys.readouterr().out.splitlines())
    assert line["state"] == "failed" and "absent" in line["message"]


def test_a_bag_in_which_nothing_is_seen_fails(
    tmp_path: Path, in_process: RunTraining, capsys: pytest.CaptureFixture[str]
) -> None:
    points, confidence = people(5)
    write_bag(tmp_path / "dark", "/keypoints", frames(points, 0 * confidence))
    words = ("--bag", str(tmp_path / "dark"), "--keypoint-layout", "coco17", *QUICK)
    assert in_process(*words, "--output", str(tmp_path)) == 2
    assert "none of the 5 frames" in capsys.readouterr().err


def test_the_ground_truth_is_not_read(
    arguments: list[str],
    models: Path,
    in_process: RunTraining,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    points, confidence = people()
    found = []
    for shapes in (None, np.full((60, 17, 3), np.nan, np.float32)):
        dataset = Dataset(points, confidence > 0, COCO17, "made up", shapes)
        monkeypatch.setattr(run, "read_data", lambda config, reporter, e=dataset: (e, "", ()))
        assert in_process(*arguments, "--steps", "5") == 0
        found.append(load_model(models / "mine.safetensors"))
    assert found[0].quality == found[1].quality
    np.testing.assert_array_equal(found[0].object_frame, found[1].object_frame)
    pairs = zip(found[0].network.named_weights(), found[1].network.named_weights(), strict=True)
    for (name, a), (_, b) in pairs:
        np.testing.assert_array_equal(a, b, err_msg=name)


PAW = """
name: paw
keypoints: [heel, toe_1, toe_2, toe_3, toe_4]
edges: [[heel, toe_1], [heel, toe_4]]
handedness: {left: toe_1, right: toe_4, up: heel, front: toe_2}
reference: [toe_1, toe_4]
reference_length: 0.04
"""


def write_paws(folder: Path, name: str = "paws") -> Path:
    """Write a bag of five points that move."""
    points, confidence = people()
    write_bag(folder / name, "/paws", frames(points[:, :5], confidence[:, :5]))
    return folder / name


def test_a_layout_file_makes_a_model_in_metres(
    tmp_path: Path, models: Path, in_process: RunTraining
) -> None:
    (tmp_path / "paw.yaml").write_text(PAW)
    words = ("--bag", str(write_paws(tmp_path)), "--object", str(tmp_path / "paw.yaml"))
    assert in_process(*words, *QUICK, "--steps", "3", "--output", str(models)) == 0
    model = assert_lifts(models / "mine.safetensors")
    assert model.layout == read_layout(tmp_path / "paw.yaml")
    points, confidence = people(4)
    shapes = Lifter(model)(points[:, :5], confidence[:, :5]).shapes
    np.testing.assert_allclose(np.linalg.norm(shapes[:, 1] - shapes[:, 4], axis=1), 0.04, rtol=1e-4)
    # A layout that is no preset goes on by its model.
    again = (*words[:2], "--object", str(models / "mine.safetensors"), *QUICK, "--name", "next")
    assert in_process(*again, "--steps", "3", "--output", str(models)) == 0
    assert load_model(models / "next.safetensors").layout == model.layout


def test_points_that_nobody_described_are_numbered(
    tmp_path: Path,
    models: Path,
    in_process: RunTraining,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ("--bag", str(write_paws(tmp_path)), "--object", "numbered", "--steps", "3", *QUICK)
    assert in_process(*words, "--output", str(models)) == 0
    model = assert_lifts(models / "mine.safetensors")
    assert model.layout.keypoints == tuple(f"point_{i}" for i in range(5))
    assert not model.layout.edges
    said = capsys.readouterr().err
    assert "'points5' names no handedness: depth may come out mirrored as a whole" in said
    assert "names no handedness" in (models / "mine.html").read_text()


def mark_as_good(path: Path) -> bytes:
    """Let a model file say that the judge did not doubt it; return its content."""
    model = load_model(path)
    judgement = {"doubtful": False, "reason": "made up"}
    save_model(path, dataclasses.replace(model, provenance={"judgement": judgement}))
    return path.read_bytes()


def paws(folder: Path, models: Path) -> tuple[str, ...]:
    """Write a bag of paws; return the words of a quick training on it."""
    (folder / "paw.yaml").write_text(PAW)
    data = ("--bag", str(write_paws(folder)), "--object", str(folder / "paw.yaml"))
    return (*data, *QUICK, "--output", str(models), "--few-frames", "0", "--seeds", "1")


def test_a_good_model_of_the_name_is_compared_with_and_not_lost(
    tmp_path: Path,
    models: Path,
    in_process: RunTraining,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = paws(tmp_path, models)
    path = models / "mine.safetensors"
    assert in_process(*words, "--steps", "150") == 0
    good = mark_as_good(path)
    capsys.readouterr()
    assert in_process(*words, "--steps", "1") == 0  # a poor one
    said = capsys.readouterr().out
    assert "the new model is doubtful: " in said
    assert "judged beside model 'mine' on the 60 frames of its training" in said
    assert "; model 'mine' stays as it was" in said
    assert path.read_bytes() == good
    doubtful = load_model(models / "mine_doubtful.safetensors")
    assert doubtful.provenance["judgement"]["rival"] == "mine"

    for steps in (4, 5):
        with monkeypatch.context() as cancelled:
            cancelled.setattr(train, "stop_on_signals", stop_after(steps))
            assert in_process(*words, "--steps", "150") == 130
    assert {record.name for record in find_records(models)} == {"mine", "mine_unfinished"}
    said = capsys.readouterr().out
    assert f"{models / 'mine_unfinished.safetensors'} holds what was learned so far" in said
    assert "; model 'mine' stays as it was" in said and path.read_bytes() == good

    assert in_process(*words, "--resume") == 0  # the same once more: as good
    assert not find_records(models)  # the earlier one is given up
    said = capsys.readouterr().out
    assert "the new model is as good as model 'mine'" in said
    assert "the model 'mine' that was there is kept as 'mine_before'" in said
    assert (models / "mine_before.safetensors").read_bytes() == good
    assert load_model(path).provenance["step"] == 150
    names = [f"mine{end}{suffix}" for end in ("", "_before") for suffix in SUFFIXES]
    assert set(names) <= {f.name for f in models.iterdir()}
    rows = re.findall(
        r"<td>(mine[a-z_]*)</td><td>(.*?)</td>", path.with_suffix(".html").read_text()
    )
    assert ("mine", "as_good") in rows and ("mine_before", "at hand") in rows


def test_a_good_model_of_another_object_gives_its_name(
    tmp_path: Path,
    models: Path,
    arguments: list[str],
    in_process: RunTraining,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = paws(tmp_path, models)
    assert in_process(*words, "--steps", "1") == 0
    good = mark_as_good(models / "mine.safetensors")
    doubt = judge.Judgement("worse", "", judge.Figures(*[0.1] * 9))
    monkeypatch.setattr(judge, "judge", lambda *_: doubt)
    assert in_process(*arguments, "--steps", "3") == 0
    assert "the model 'mine' that was there is kept as 'mine_before'" in capsys.readouterr().out
    assert (models / "mine_before.safetensors").read_bytes() == good
    assert not (models / "mine_doubtful.safetensors").exists()


def test_a_first_look_is_not_offered_for_use(tmp_path: Path) -> None:
    alone = judge.Judgement("", "it is alone", judge.Figures(*[0.1] * 9))
    for judgement, use in (
        (alone, "use it: lift FILE"),
        (alone._replace(is_first_look=True), "too few steps for use, but you can look at what it"),
        (alone._replace(verdict="unknown"), "whether it is better is unknown; to use it: lift"),
        (alone._replace(fits_badly=True), "it fits badly; look at what it lifts: lift FILE"),
        (alone._replace(reason="worse"), "not in use, but you can look at what it lifts: lift"),
    ):
        assert train._next_steps(HUMAN25, tmp_path / "mine.safetensors", judgement)[0].startswith(
            use
        )
    (use, *_) = train._next_steps(HUMAN25, tmp_path / "mine.safetensors", alone)
    assert use.endswith("or in a lifter: ros2 param set /lifter model mine")


def test_a_model_of_another_object_needs_two_commands(tmp_path: Path) -> None:
    dog = KeypointLayout("dog", ("nose", "withers", "tail", "paw"))
    alone = judge.Judgement("", "it is alone", judge.Figures(*[0.1] * 9))
    (use,) = train._next_steps(dog, tmp_path / "dog.safetensors", alone)
    assert use.endswith(
        "or in a lifter: ros2 param set /lifter keypoint_layout model, and then ros2 param set "
        "/lifter model dog"
    )


def test_a_new_model_must_be_better_than_the_one_at_hand_and_that_of_its_name(
    arguments: list[str], models: Path, in_process: RunTraining, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert in_process(*arguments, "--steps", "3") == 0
    good = mark_as_good(models / "mine.safetensors")
    judged: list[str] = []

    def stand_in(
        frames: Any, model: Model, rival: Model | None, faults: tuple[str, ...]
    ) -> judge.Judgement:
        judged.append(rival.name if rival else "")
        figures = judge.Figures(*[0.1] * 9)
        reason = "worse" if judged[-1] == "mine" else ""
        return judge.Judgement(reason, "it is better", figures, judged[-1], figures)

    monkeypatch.setattr(judge, "judge", stand_in)
    assert in_process(*arguments, "--steps", "3") == 0
    assert judged == ["human", "mine"]
    assert (models / "mine.safetensors").read_bytes() == good
    provenance = load_model(models / "mine_doubtful.safetensors").provenance
    assert provenance["judgement"]["rival"] == "mine"


def test_it_goes_on_from_another_model(
    bag: Path,
    arguments: list[str],
    models: Path,
    in_process: RunTraining,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert in_process(*arguments, "--steps", "3") == 0
    first = load_model(models / "mine.safetensors")
    assert time.strptime(first.provenance["date"], "%Y-%m-%d")
    # Weights that hardly move show where they come from.
    still = ("--bag", str(bag), "--keypoint-layout", "coco17", "--from", "mine", "--threads", "1")
    slow = ("--steps", "1", "--learning-rate", "1e-7", "--output", str(models), FORCE)
    assert in_process(*still, *slow, "--name", "same") == 0
    same = load_model(models / "same.safetensors")
    assert same.layout == first.layout == HUMAN25
    assert same.provenance["from"]["model"] == "mine"
    for (name, a), (_, b) in zip(
        same.network.named_weights(), first.network.named_weights(), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=1e-6, err_msg=name)
    capsys.readouterr()
    assert in_process(*still, *slow, "--name", "other", "--object", "coco17") == 0
    other = load_model(models / "other.safetensors")
    assert other.layout == COCO17
    np.testing.assert_array_equal(other.object_frame, first.object_frame)
    assert "handedness" not in capsys.readouterr().err  # that is inherited


def test_it_does_not_resume_what_started_elsewhere(
    arguments: list[str],
    models: Path,
    in_process: RunTraining,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert in_process(*arguments, "--steps", "3") == 0
    start = (*arguments[: -len(QUICK)], "--name", "next", "--steps", "12", "--batch", "8", FORCE)
    with monkeypatch.context() as cancelled:
        cancelled.setattr(train, "stop_on_signals", stop_after(4))
        assert in_process(*start, "--from", "mine") == 130
    # The same data, but the whitening of another training.
    path = models / "mine.safetensors"
    model = load_model(path)
    twice = dataclasses.replace(model.network, L=2 * model.network.L)
    save_model(path, dataclasses.replace(model, network=twice))
    assert in_process(*start, "--from", "mine", "--resume") == 2
    assert "another model to start from" in capsys.readouterr().err


def write_people(path: Path, points: np.ndarray) -> tuple[str, ...]:
    write_bag(path, "/keypoints", frames(points, np.full(points.shape[:2], 0.9, np.float32)))
    return ("--bag", str(path), "--keypoint-layout", "coco17", *QUICK, "--output", str(path.parent))


def test_data_that_cannot_work_is_refused_before_training(
    tmp_path: Path, in_process: RunTraining, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    flat = people(1)[0][0] * rng.uniform(0.5, 2, (60, 1, 1))
    flat += rng.standard_normal(flat.shape)
    words = write_people(tmp_path / "flat", flat.astype(np.float32))
    assert in_process(*words, "--min-change", "0") == 2
    assert "the views are flat" in capsys.readouterr().err
    assert in_process(*words) == 2  # thinned to next to nothing
    assert "at least 10 that differ are needed" in capsys.readouterr().err
    assert not list(tmp_path.glob("mine*"))


def test_what_the_data_was_spared_is_said_and_an_option_turns_it_off(
    tmp_path: Path, in_process: RunTraining, capsys: pytest.CaptureFixture[str]
) -> None:
    words = write_people(tmp_path / "twice", np.repeat(people()[0], 2, axis=0))
    assert in_process(*words, "--steps", "2") == 0
    said = capsys.readouterr()
    assert "of 120 frames, left out 60 near-duplicates" in said.err
    assert "warning: 60 frames are few" in said.err
    assert "60 frames are few" in (tmp_path / "mine.html").read_text()
    assert load_model(tmp_path / "mine.safetensors").provenance["frames"] == 60
    assert in_process(*words, "--steps", "2", "--min-change", "0") == 0
    assert load_model(tmp_path / "mine.safetensors").provenance["frames"] == 120


def test_doubts_about_depth_are_said_in_the_report_and_at_the_end(
    arguments: list[str],
    models: Path,
    in_process: RunTraining,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = (*arguments, "--steps", "3")
    for told in ("", "no depth in mine"):
        monkeypatch.setattr(train, "handedness_warning", lambda model, dataset, told=told: told)
        assert in_process(*words, "--json-progress") == 0
        *_, end = map(json.loads, capsys.readouterr().out.splitlines())
        assert (end["state"], end.get("warning", "")) == ("finished", told)
        assert ("no depth in mine" in (models / "mine.html").read_text()) == bool(told)
    assert in_process(*words) == 0
    assert "warning: no depth in mine" in capsys.readouterr().err


def test_a_model_whose_factorisations_were_cut_short_says_what_would_help(
    tmp_path: Path,
    models: Path,
    in_process: RunTraining,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from deep_nrsfm_ros.training import few_frames

    monkeypatch.setattr(few_frames, "seconds_at_most", lambda *_: 130.0)
    limits = ("--minutes", "0.005", "--steps", "2000")
    words = ("--bag", str(write_paws(tmp_path)), "--object", "numbered", *limits, *QUICK)
    assert in_process(*words, "--output", str(models)) == 0
    wanted = "were cut short: give --minutes 3.5 (train.minutes), or leave it out"
    said = capsys.readouterr().err
    assert said.index("take up to about 130 s here") < said.index("warning: the factorisations")
    assert wanted in said
    assert wanted in (models / "mine.html").read_text()
    assert load_model(models / "mine.safetensors").provenance["factorisation_needs_minutes"] == 3.5


def test_a_report_that_cannot_be_written_costs_no_model(
    arguments: list[str],
    models: Path,
    in_process: RunTraining,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (models / "mine.html").mkdir(parents=True)
    assert in_process(*arguments, "--steps", "3") == 0
    assert "no report was written" in capsys.readouterr().err
    assert_lifts(models / "mine.safetensors")
    assert sorted(f.name for f in models.iterdir()) == ["mine.html", "mine.safetensors"]


def test_a_model_of_data_that_looks_wrong_is_doubtful(
    models: Path, in_process: RunTraining, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points, confidence = in_layout(COCO17)
    percent = np.concatenate([points, 100 * confidence[..., None]], -1)
    np.save(tmp_path / "a.npy", percent)
    words = ("--input", str(tmp_path / "a.npy"), "--keypoint-layout", "coco17", "--threads", "1")
    few = ("--steps", "3", "--learning-rate", "1e-7", "--name", "mine", "--output", str(models))
    assert in_process(*words, *few, "--json-progress") == 3
    end = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert end["state"] == "finished" and end["judgement"] == "doubtful"
    fault = "a.npy: confidence up to "
    assert f"the new model is doubtful: its data looks wrong: {fault}" in end["message"]
    assert "divide it by 100. Mend it and train again" in end["message"]
    judgement = load_model(models / "mine.safetensors").provenance["judgement"]
    assert judgement["doubtful"] and judgement["faults"][0].startswith(fault)
    page = html.unescape((models / "mine.html").read_text())
    assert (
        "its data looks wrong: a.npy: confidence up to" in page
        and "<td>mine</td><td>doubtful</td>" in page
    )
    assert in_process(*words, *few, FORCE) == 0
    said = capsys.readouterr()
    assert said.err.count(" divide it by 100") == 1 and "divide" not in said.out
    verdict, figures, *_ = said.out.splitlines()
    assert verdict.startswith(
        "finished: the new model is doubtful: its data looks wrong: a.npy: con"
    )
    assert verdict.endswith(". Mend it as the warnings say, and train again") and len(verdict) < 170
    assert figures.startswith("  judged beside model 'human' on the ") and "image error" in figures
    np.save(tmp_path / "a.npy", percent / [1, 1, 100])
    assert in_process(*words, *few) == 0
    assert "looks wrong" not in capsys.readouterr().err.split("curating")[-1]


def test_a_configuration_file_gives_the_options_that_are_not_given(
    arguments: list[str],
    models: Path,
    in_process: RunTraining,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = TrainingConfig.from_arguments(train.parser().parse_args([*arguments, "--batch", "5"]))
    file = tmp_path / "config.json"
    file.write_text(config.to_json())
    assert in_process("--config", str(file), "--steps", "3", FORCE) == 0
    recipe = load_model(models / "mine.safetensors").provenance["recipe"]
    assert (recipe["steps"], recipe["batch"]) == (3, 5)
    file.write_text('{"data": {"bag": []}}')
    assert in_process("--config", str(file)) == 2
    assert "config.json: data.bag is no option" in capsys.readouterr().err
