# SPDX-License-Identifier: Apache-2.0
"""`replay` from end to end: pages of recordings with and without answers, and the live page."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.commands.replay import live_layout, main
from deep_nrsfm_ros.data.bags import frames, write_bag
from deep_nrsfm_ros.data.detections import Detections, stamps_at
from deep_nrsfm_ros.data.lifted_bags import write_lifted_bag
from deep_nrsfm_ros.layouts.presets import COCO17, HUMAN25
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.model_files.model_file import load_model
from deep_nrsfm_ros.nrsfm.geometry import random_cameras
from test.fixtures.forked_python import NODE, ForkedPython


@pytest.fixture
def points() -> np.ndarray:
    """Return (5, 25, 2) of something that a camera goes round."""
    shape = np.random.default_rng(0).standard_normal((25, 3))
    views = 100 * shape @ random_cameras(5, np.random.default_rng(1)) + 400
    return views.astype(np.float32)


@pytest.fixture
def keypoints(tmp_path: Path, points: np.ndarray) -> Path:
    """Return a bag of keypoints alone."""
    write_bag(tmp_path / "keypoints", "/keypoints", frames(points, np.ones((5, 25)), 10))
    return tmp_path / "keypoints"


@pytest.fixture
def answered(tmp_path: Path, points: np.ndarray) -> Path:
    """Return a bag with answers that no model gives: every point at its place in the image."""
    shapes = np.concatenate([points, np.zeros((5, 25, 1))], -1).astype(np.float32) / 1000
    ones, places = np.ones(5, np.float32), np.zeros((5, 2), np.float32)
    rotations = np.tile(np.eye(3, dtype=np.float32), (5, 1, 1))
    sure = np.full((5, 25), 0.5, np.float32)
    order = np.arange(5)
    seen = Detections(points, 2 * sure, order, np.array(["0"] * 5), stamps_at(10, 5) + 10**18)
    lifted = Lifted(shapes, rotations, ones, places, 0 * ones, sure, sure < 0)
    write_lifted_bag(tmp_path / "answered", seen, lifted)
    return tmp_path / "answered"


def shown(path: Path) -> list[dict[str, Any]]:
    """Return the first object of every frame on a page."""
    (data,) = re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', path.read_text())
    return [frame["objects"][0] for frame in json.loads(data)["frames"]]


def test_keypoints_are_lifted(keypoints: Path, tmp_path: Path) -> None:
    main([str(keypoints), "--html", str(tmp_path / "page.html")])
    objects = shown(tmp_path / "page.html")
    assert len(objects) == 5
    assert all(len(one["shape"]) == 3 * len(HUMAN25) and one["rotation"] for one in objects)
    assert "lifted with model human" in (tmp_path / "page.html").read_text()


def test_answers_are_shown_as_they_were_recorded(
    answered: Path, points: np.ndarray, tmp_path: Path
) -> None:
    main([str(answered), "--html", str(tmp_path / "page.html")])
    objects = shown(tmp_path / "page.html")
    for one, expected in zip(objects, points / 1000, strict=True):
        found = np.reshape(one["shape"], (25, 3))
        np.testing.assert_allclose(found[:, :2], expected - expected.mean(0), atol=1e-3)
        assert one["rotation"] == [1, 0, 0, 0, 1, 0, 0, 0, 1] and one["confidence"] == [0.5] * 25
    main([str(answered), "--lift-again", "--html", str(tmp_path / "again.html")])
    assert shown(tmp_path / "again.html")[0]["shape"] != objects[0]["shape"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["keypoints"], "--html FILE, --serve, or both"),
        (["--html", "page.html"], "--html needs a BAG"),
        (["--serve", "--rate", "25"], "--rate has no effect here: it needs a recording"),
        (["--serve", "--field-of-view", "65"], "--field-of-view has no effect here: it needs a"),
        (["--serve", "--objects", "largest"], "--objects has no effect here: it needs a rec"),
        (["nowhere", "--html", "page.html"], "nowhere does not exist"),
        (["keypoints", "--html", "no/page.html"], "no/page.html"),
        (["keypoints", "--html", "page.html", "--model", "cmu31"], "has 25 keypoints"),
        (
            ["answered", "--html", "page.html", "--field-of-view", "65"],
            "--field-of-view has no effect on the lifted points of a bag",
        ),
        (
            ["answered", "--html", "page.html", "--model", "cmu31", "--keypoint-layout", "human25"],
            "name the model that lifted",
        ),
    ],
)
def test_what_is_wrong_is_said(
    keypoints: Path,
    answered: Path,
    words: list[str],
    expected: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(keypoints.parent)
    with pytest.raises(SystemExit) as end:
        main(words)
    said = capsys.readouterr().err
    assert end.value.code == 2 and "failed: " in said and expected in said


def test_the_layout_of_a_running_lifter(capsys: pytest.CaptureFixture[str]) -> None:
    model = load_model("human")
    assert live_layout("/lifter", "coco17", model) is COCO17
    assert not capsys.readouterr().err
    assert live_layout("/lifter", "mine", model) is model.layout
    assert "uses the layout 'mine', which is no preset" in capsys.readouterr().err


def test_a_recording_is_served_until_ctrl_c(answered: Path) -> None:
    words = ("-m", "deep_nrsfm_ros.commands.replay", answered, "--serve", "--port", "0")
    process = ForkedPython(words, NODE, stdout=subprocess.PIPE)
    try:
        assert process.stdout
        address = process.stdout.readline().split()[0]
        urllib.request.urlopen(f"{address}frames").close()  # one that leaves at once
        with urllib.request.urlopen(f"{address}frames") as events:
            got = [line for line in events.read().decode().splitlines() if line.startswith("data")]
        assert len(got) == 6 and json.loads(got[4].removeprefix("data: "))["t"] == 1e9 + 0.4
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
    finally:
        process.kill()
        process.wait()
