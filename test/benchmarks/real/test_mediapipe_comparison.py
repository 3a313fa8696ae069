# SPDX-License-Identifier: Apache-2.0
"""The table of real detections on a made-up session, where MediaPipe is right about everything."""

from __future__ import annotations

import csv
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.data import pose2sim_scenes
from benchmarks.data.pose2sim_scenes import LIMBS, PoseDetections
from benchmarks.real import mediapipe_comparison
from deep_nrsfm_ros.data.cameras import Camera
from deep_nrsfm_ros.data.pose2sim import JOINTS, WHEEL
from deep_nrsfm_ros.layouts.presets import BODY25B

FRAMES = 12


def seen_by(camera: Camera, world: np.ndarray) -> PoseDetections:
    """Return what a perfect MediaPipe makes of limbs (f, 12, 3) mm: all but the rest of the 33."""
    f = len(world)
    points, confidence, shapes = np.zeros((f, 33, 2)), np.zeros((f, 33)), np.zeros((f, 33, 3))
    points[:, LIMBS], confidence[:, LIMBS] = camera.project(world), 0.9
    inside = camera.to_camera(world) / 1000
    shapes[:, LIMBS] = inside - inside.mean(1, keepdims=True)
    return PoseDetections(points, confidence, shapes, np.full(f, 0.1))


@pytest.fixture
def output(
    tmp_path: Path,
    ring: list[Camera],
    moving: Any,
    write_session: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> Path:
    """Return an output folder that holds what MediaPipe saw of the session's videos."""
    write_session(tmp_path / WHEEL, ring, ring, [0.0] * 4, FRAMES)
    monkeypatch.setattr(pose2sim_scenes, "CACHE", tmp_path)
    places = [BODY25B.index(joint) for joint in JOINTS]
    times = {"Balancing": np.arange(FRAMES), "Static": np.zeros(5)}
    with zipfile.ZipFile(tmp_path / WHEEL, "a") as archive:
        for trial, moments in times.items():
            folder = tmp_path / "out" / "mediapipe-0.10.14" / trial
            folder.mkdir(parents=True)
            for camera in ring:
                path = f"Pose2Sim/Demo/S00_Demo_Session/P/T_{trial}Trial/videos/{camera.name}.mp4"
                archive.writestr(path, "not looked at")
                mediapipe = seen_by(camera, moving(moments)[:, places])
                np.savez(folder / f"{camera.name}.npz", **mediapipe._asdict())
    return tmp_path / "out"


def test_a_perfect_mediapipe_makes_no_error(
    data: Path, output: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mediapipe_comparison.main(["--data", str(data), "--output", str(output), "--subjects", "01"])
    printed = capsys.readouterr().out
    assert printed.strip() == (output / "mediapipe_comparison.md").read_text().strip()
    assert (output / "mediapipe_comparison.png").stat().st_size > 1000
    rows = list(csv.DictReader((output / "mediapipe_comparison.csv").open()))
    cameras = ["cam01", "cam02", "cam03", "cam04", "mean"]
    found: dict[tuple[str, str], list[dict[str, str]]] = {
        (row["trial"], row["system"]): [] for row in rows
    }
    for row in rows:
        found[row["trial"], row["system"]].append(row)
    assert all([row["camera"] for row in group] == cameras for group in found.values())
    systems = list(mediapipe_comparison.SYSTEMS)
    assert [key[1] for key in found if key[0] == "balancing"] == systems
    # The detections that come with the standing trial are made up.
    assert [key[1] for key in found if key[0] == "standing"] == [
        system for system in systems if not system.startswith(mediapipe_comparison.ON_CLIP)
    ]
    for (trial, system), group in found.items():
        perfect, mean = system == mediapipe_comparison.WORLD, group[-1]
        assert (float(mean["PA mm"]) < 2) == perfect
        if perfect:
            assert float(mean["camera mm"]) < 5 and float(mean["mirrored %"]) == 0
            assert float(mean["ms"]) == pytest.approx(100)
        if trial == "standing" and system != mediapipe_comparison.MEAN_SHAPE:
            assert float(mean["jitter deg"]) < 0.01
        else:
            assert mean["jitter deg"] == ""


def test_without_mediapipe_it_says_what_to_do(
    data: Path, output: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (output / "mediapipe-0.10.14" / "Static" / "cam02.npz").unlink()
    monkeypatch.setitem(sys.modules, "deep_nrsfm_ros.node.mediapipe_detector", None)
    with pytest.raises(SystemExit, match="2"):
        mediapipe_comparison.main(["--data", str(data), "--output", str(output)])
    assert "`make demo-live` installs MediaPipe" in capsys.readouterr().err


def test_jitter_is_the_angle_between_neighbours() -> None:
    shape = np.random.default_rng(0).standard_normal((12, 3))
    turns = Rotation.from_rotvec(np.radians(2.0 * np.arange(9))[:, None] * [0, 0.6, 0.8])
    shapes = shape @ turns.as_matrix() + np.arange(9)[:, None, None]
    shapes[4] = np.nan  # nobody was seen
    assert mediapipe_comparison.jitter(shapes) == pytest.approx(2)


def test_mean_shape_of_one_shape_seen_from_everywhere_is_that_shape() -> None:
    rng = np.random.default_rng(0)
    shape = rng.standard_normal((12, 3))
    shapes = rng.uniform(1, 2, (30, 1, 1)) * (shape @ Rotation.random(30, rng).as_matrix())
    mean = mediapipe_comparison.mean_shape(shapes)
    error = mediapipe_comparison.scores(mean[None], shape[None] - 7)
    assert error["PA mm"] < 1e-6 and error["mirrored %"] == 0
