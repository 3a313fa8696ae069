# SPDX-License-Identifier: Apache-2.0
"""The demo from wheel to picture and trained model, in real processes over real DDS."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.commands.demo.client import Played
from deep_nrsfm_ros.commands.demo.evaluation import read_points
from deep_nrsfm_ros.data.pose2sim import WHEEL, fetch_wheel
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.model_files.model_file import Model, load_model, save_model
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from test.fixtures.forked_python import (
    NODE,
    ROOT,
    ForkedPython,
    children_of,
    orphans_come_to_this_process,
)

Start = Callable[..., "subprocess.Popen[str]"]


def test_the_wheel_is_fetched_only_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def download(command: list[str], check: bool) -> None:
        assert command[1:4] == ["-m", "pip", "download"] and command[-1] == "pose2sim==0.6.0"
        folder = Path(command[command.index("--dest") + 1])
        folder.mkdir(parents=True)
        (folder / WHEEL).write_bytes(b"wheel")
        monkeypatch.setattr(subprocess, "run", None)

    monkeypatch.setattr(subprocess, "run", download)
    for _ in range(2):
        assert fetch_wheel(tmp_path / "cache") == tmp_path / "cache" / WHEEL
    assert (tmp_path / "cache" / WHEEL).read_bytes() == b"wheel"


def test_a_download_that_fails_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(OSError, match=f"put {WHEEL} into {tmp_path}"):
        fetch_wheel(tmp_path)


def test_a_latency_below_zero_is_no_latency() -> None:
    assert Played([1, 2], [0.002, 0.004], 30.0, 0.1).latency(50) == pytest.approx(3.0)
    assert np.isnan(Played([1, 2], [0.002, -0.00026], 30.0, 0.1).latency(99))
    assert np.isnan(Played([1, 2], [], 30.0, 0.1).latency(50))


@pytest.fixture
def start(tmp_path: Path) -> Start:
    """Return a function that starts the demo with an untrained model.

    `forks=False` starts Python for the demo, and for all that it starts in turn.
    """
    network = initialise(Architecture(widths=(16, 8)), len(HUMAN17), np.random.default_rng(0))
    model = Model("untrained", network, HUMAN17, Normaliser(), np.eye(3, dtype=np.float32))
    save_model(tmp_path / "untrained.safetensors", model)

    def run(forks: bool = True, **options: Any) -> subprocess.Popen[str]:
        options = {
            "output": tmp_path / "output",
            "model": tmp_path / "untrained.safetensors",
        } | options
        words = [f"--{name.replace('_', '-')}={value}" for name, value in options.items()]
        words = ["-m", "deep_nrsfm_ros.commands.demo", "--node", *words]
        output: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        if forks:
            return ForkedPython(words, NODE, forks=True, **output)
        output |= {"text": True, "env": os.environ | {"PYTHONPATH": str(ROOT)}}
        return subprocess.Popen([sys.executable, *words], **output)

    return run


@pytest.fixture
def left_behind() -> Iterator[Callable[[], list[int]]]:
    """Return a function that returns the processes that have outlived their parents, and go on."""
    before = children_of(os.getpid())

    def find() -> list[int]:
        orphans = [pid for pid in children_of(os.getpid()) if pid not in before]
        return [pid for pid in orphans if not os.waitpid(pid, os.WNOHANG)[0]]

    with orphans_come_to_this_process():
        yield find


@pytest.mark.timeout(420)  # on a machine that does other work
def test_demo_from_keypoints_to_trained_model(
    start: Start, left_behind: Callable[[], list[int]], tmp_path: Path
) -> None:
    process = start(forks=False, train_steps=20)
    said, _ = process.communicate(timeout=400)
    assert process.returncode == 0, said
    output = tmp_path / "output"
    table = [line.split() for line in said.splitlines() if line.lstrip().startswith(("cam", "mea"))]
    assert [row[0] for row in table] == ["camera", "cam01", "cam02", "cam03", "cam04", "mean"]
    assert all(float(row[4]) > 0 for row in table[1:])
    assert all(row[1] == "100" and 10 <= float(row[2]) <= 100 for row in table[1:])
    assert len(read_points(output / "lifted")) >= 200
    assert len(said.splitlines()) <= 40 and (output / "demo.html").as_uri() in said
    assert 'href="standing.html"' in (output / "demo.html").read_text()
    assert 'href="demo.html"' in (output / "standing.html").read_text()
    assert (output / "demo.png").read_bytes().startswith(b"\x89PNG")
    assert load_model(output / "models" / "demo.safetensors").layout == HUMAN17
    assert said.count("mm aligned") == 2  # of both models
    changed = "changed from model 'untrained' to 'demo' and lifted" in said
    assert changed != ("goes on with model 'untrained'" in said)
    assert changed != ("the new model is doubtful" in said)
    assert not left_behind()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("moment", ["playing", "training 'demo'"])
def test_stopped_demo_leaves_nothing_behind(
    start: Start, left_behind: Callable[[], list[int]], number: signal.Signals, moment: str
) -> None:
    # Forked, a demo that is stopped during the training crashes as its libraries unload (SIGSEGV).
    process = start(forks=moment == "playing", train_steps=1_000_000)
    assert process.stdout is not None
    said = ""
    while moment not in said:
        line = process.stdout.readline()
        assert line, said
        said += line
    time.sleep(1)
    process.send_signal(number)
    said += process.communicate(timeout=20)[0]
    assert process.returncode == 130 and "Traceback" not in said, said
    assert not left_behind()


def test_unknown_model_is_a_message(start: Start) -> None:
    process = start(model="nobody")
    said, _ = process.communicate(timeout=60)
    assert process.returncode == 1 and "demo: no model 'nobody'" in said and "Traceback" not in said
