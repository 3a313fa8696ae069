# SPDX-License-Identifier: Apache-2.0
"""A training that is cut off goes on as it was asked for and leaves no half-written model."""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.data.bags import frames, write_bag
from deep_nrsfm_ros.model_files.model_file import load_model
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras
from deep_nrsfm_ros.training.record import checkpoint_file, read_record, record_file
from test.fixtures.forked_python import TRAINING, ForkedPython
from test.fixtures.training_program import RunTraining

DEADLINE = 60.0
PROGRAM = ("-m", "deep_nrsfm_ros.commands.train", "--json-progress")
NEW: tuple[str, ...] = ("--bag", "bag", "--keypoint-layout", "coco17", "--batch", "8")
NEW += ("--widths", "8", "4", "--seeds", "1")
Said = Callable[..., dict[str, Any]]


class Folder:
    """A bag and a folder of models; starts trainings of `mine` there."""

    def __init__(self, path: Path) -> None:
        rng = np.random.default_rng(0)
        shapes = centre(rng.standard_normal((17, 3)) + 0.3 * rng.standard_normal((60, 17, 3)))
        points = 100 * (shapes @ random_cameras(60, rng)) + [320, 240]
        write_bag(path / "bag", "/keypoints", frames(points, np.ones((60, 17))))
        self.path, self.models = path, path / "models"
        self.started: list[subprocess.Popen[str]] = []

    def begin(self, *words: str) -> subprocess.Popen[str]:
        """Start a training anew, from a path that means nothing elsewhere."""
        return self.start(*NEW, *words, cwd=self.path)

    def start(self, *words: str, cwd: Path | None = None) -> subprocess.Popen[str]:
        """Start a training, or one that goes on."""
        pipes: dict[str, Any] = dict.fromkeys(("stdin", "stdout"), subprocess.PIPE)
        words = (*PROGRAM, *words, *self.common())
        process = ForkedPython(words, TRAINING, cwd=cwd or "/", **pipes)
        self.started.append(process)
        return process

    def common(self) -> tuple[str, ...]:
        """Return the words of all trainings."""
        return ("--threads", "1", "--name", "mine", "--output", str(self.models))

    def names(self) -> list[str]:
        return sorted(path.name for path in self.models.glob("*"))


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Folder]:
    folder = Folder(tmp_path)
    yield folder
    for process in folder.started:
        with process:
            process.kill()


@pytest.fixture
def said(
    folder: Folder,
    in_process: RunTraining,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> Said:
    """Train within the test; return the last thing that is said."""

    def run(*words: str) -> dict[str, Any]:
        monkeypatch.chdir(folder.path)
        capsys.readouterr()
        in_process(*words, *folder.common(), "--json-progress")
        last: dict[str, Any] = json.loads(capsys.readouterr().out.splitlines()[-1])
        return last

    return run


def wait_for(condition: Callable[[], Any], what: str) -> None:
    deadline = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.02)


def lines_of(process: subprocess.Popen[str]) -> list[dict[str, Any]]:
    """Return all that a process says until it ends by itself."""
    lines = [json.loads(line) for line in process.stdout or ()]
    process.wait(DEADLINE)
    return lines


def test_a_cancelled_training_goes_on_with_nothing_but_its_name(folder: Folder, said: Said) -> None:
    process = folder.begin("--steps", "1000000", "--cycle", "1.5")
    wait_for(record_file(folder.models, "mine").exists, "the record")
    second = said(*NEW, "--steps", "3")
    assert second["state"] == "failed" and "another process trains 'mine'" in second["message"]
    found = read_record(folder.models, "mine")
    assert found is not None and found.running and "another process" in str(found)
    for line in process.stdout or ():
        if json.loads(line)["state"] == "training":
            break
    process.send_signal(signal.SIGTERM)
    cancelled = lines_of(process)[-1]
    assert "--resume --name mine goes on" in cancelled["message"], cancelled
    found = read_record(folder.models, "mine")
    assert found is not None and found.saved and not found.running
    assert found.config is not None
    assert found.config.data.bags == (folder.path / "bag",) and found.config.recipe.steps == 1000000
    assert "train.resume to true" in found.advice

    steps = load_model(folder.models / "mine.safetensors").provenance["step"] + 20
    *before, last = lines_of(folder.start("--resume", "--steps", str(steps)))
    assert last["state"] == "finished", last
    warnings = [line["message"] for line in before if " was " in line.get("message", "")]
    change = f"warning: since this training began, --steps was 1000000, is {steps} now"
    assert warnings == [change]
    provenance = load_model(folder.models / "mine.safetensors").provenance
    assert (provenance["step"], provenance["recipe"]["cycle"]) == (steps, 1.5)
    assert provenance["recipe"]["batch"] == 8
    assert folder.names() == ["mine.html", "mine.safetensors"]


def test_nothing_to_resume_is_said(folder: Folder, said: Said) -> None:
    last = said("--resume")
    assert last["state"] == "failed"
    assert "no unfinished training of 'mine'" in last["message"]
    folder.models.mkdir()
    checkpoint_file(folder.models, "mine").write_bytes(b"\0" * 8)
    record_file(folder.models, "mine").write_text("half a rec")
    last = said("--resume")
    assert "there is no record of the options" in last["message"]
    last = said(*NEW, "--resume", "--steps", "3")
    assert ".mine.checkpoint cannot be read" in last["message"]


def test_a_killed_training_leaves_whole_files_and_goes_on(folder: Folder, said: Said) -> None:
    folder.models.mkdir()
    delays = random.Random(0)
    assert said(*NEW, "--steps", "3")["state"] == "finished"
    process = folder.begin("--steps", "400")
    wait_for(record_file(folder.models, "mine").exists, "the record")
    for _ in range(int(os.environ.get("KILLS", "2"))):
        time.sleep(delays.uniform(0, 3))
        process.kill()
        process.wait()
        for path in folder.models.glob("*.safetensors"):
            load_model(path)
        found = read_record(folder.models, "mine")
        if found is None:  # it was faster
            break
        assert not found.running and found.config is not None
        assert found.config.recipe.steps == 400
        process = folder.start("--resume")
        time.sleep(1)
    if read_record(folder.models, "mine"):
        process.kill()
        process.wait()
        assert lines_of(folder.start("--resume"))[-1]["state"] == "finished"
    assert load_model(folder.models / "mine.safetensors").provenance["step"] == 400
    assert not [name for name in folder.names() if name.startswith(".mine.t")]


def test_a_full_disk_is_named_and_the_old_model_stays(folder: Folder, said: Said) -> None:
    assert said(*NEW, "--steps", "3")["state"] == "finished"
    before = (folder.models / "mine.safetensors").read_bytes()
    process = folder.begin("--steps", "1000000")
    for line in process.stdout or ():
        if json.loads(line)["state"] == "training":
            break
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (1024, 1024))  # no room for a file
    process.send_signal(signal.SIGTERM)
    last = lines_of(process)[-1]
    assert process.returncode == 2 and last["state"] == "failed"
    assert f"cannot write to {folder.models} (" in last["message"]
    assert "MB free on its disk" in last["message"] and "make room" in last["message"]
    assert (folder.models / "mine.safetensors").read_bytes() == before
    assert not record_file(folder.models, "mine").exists()


def test_a_folder_that_cannot_be_written_to_is_named_before_training(folder: Folder) -> None:
    folder.models = Path("/sys/kernel")  # refuses root too
    lines = lines_of(folder.begin("--steps", "3"))
    assert {line["state"] for line in lines} <= {"reading", "curating", "failed"}
    assert lines[-1]["state"] == "failed"
    assert "cannot write to /sys/kernel" in lines[-1]["message"]


def test_who_listens_may_die_and_the_training_saves(folder: Folder) -> None:
    process = folder.begin("--steps", "1000000")
    for line in process.stdout or ():
        if json.loads(line)["state"] == "training":
            break
    assert process.stdin is not None and process.stdout is not None
    process.stdout.close()
    process.stdin.close()
    assert process.wait(DEADLINE) == 130
    assert load_model(folder.models / "mine.safetensors").provenance["step"] > 0
    found = read_record(folder.models, "mine")
    assert found is not None and found.saved
