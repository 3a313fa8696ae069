# SPDX-License-Identifier: Apache-2.0
"""A score is a weight: what the detector guesses pulls little."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deep_nrsfm_ros.data.keypoint_files import read_keypoints
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.lifting.numpy_backend import NumpyBackend
from deep_nrsfm_ros.lifting.observation import Observation, outside_share, without_border
from deep_nrsfm_ros.lifting.perspective import lift_perspective
from deep_nrsfm_ros.lifting.weights import keypoint_weight, trusted
from deep_nrsfm_ros.model_files.model_file import load_model

HUMAN = load_model("human17")
LEGS = [
    i
    for i, name in enumerate(HUMAN17.keypoints)
    if name.split("_", 1)[-1] in ("knee", "ankle", "big_toe")
]
REST = [i for i in range(17) if i not in LEGS]


def people(n: int = 30) -> np.ndarray:
    """Return points (n, 17, 2) in pixels of standing people: shapes of the model, seen anew."""
    rng = np.random.default_rng(0)
    x = {"shoulder": 90, "elbow": 120, "wrist": 130, "hip": 60, "knee": 65, "ankle": 65}
    x |= {"big_toe": 75, "neck": 0, "mid_hip": 0, "nose": 0}
    y = {"shoulder": 0, "elbow": 130, "wrist": 240, "hip": 250, "knee": 480, "ankle": 700}
    y |= {"big_toe": 720, "neck": 0, "mid_hip": 250, "nose": -100}
    points = np.zeros((n, 17, 2))
    for i, name in enumerate(HUMAN17.keypoints):
        side, _, part = name.partition("_")
        part = name if name in x else part
        sign = {"left": 1, "right": -1}.get(side, 0)
        points[:, i] = 600 + sign * x[part] * 0.4, 200 + y[part] * 0.4
    return (points + rng.normal(0, 4, points.shape)).astype(np.float32)


def arms_moved(guess: float, compiled: bool) -> float:
    """Return how far guessed legs of a score move the rest, relative to missing legs."""
    points = people()
    confidence = np.full(points.shape[:2], 0.9, np.float32)
    missing, guessed = confidence.copy(), confidence.copy()
    missing[:, LEGS], guessed[:, LEGS] = 0, guess
    ghosts = points.copy()
    ghosts[:, LEGS] = 600, 320  # at the border of a cut image
    ghosts[:, LEGS] += np.random.default_rng(1).normal(0, 10, (len(points), len(LEGS), 2))
    lifter = Lifter(HUMAN)
    if not compiled:
        lifter.backend = NumpyBackend(lifter.constants)
    expected = lifter.lift(points, missing).shapes[:, REST]
    found = lifter.lift(ghosts, guessed).shapes[:, REST]
    expected, found = (S - S.mean(1, keepdims=True) for S in (expected, found))
    found *= np.linalg.norm(expected) / np.linalg.norm(found)
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize("compiled", [True, False])
def test_guessed_legs_hardly_move_the_rest(compiled: bool) -> None:
    assert arms_moved(0.2, compiled) < 0.1 < 0.3 * arms_moved(0.9, compiled) + 0.1
    assert arms_moved(0.2, compiled) < 0.4 * arms_moved(0.9, compiled)


def test_scores_that_are_all_low_are_no_doubt() -> None:
    points, lifter = people(), Lifter(HUMAN)
    for score in (1, 0.3):
        weight = keypoint_weight(np.full((1, 17), score, np.float32))
        np.testing.assert_array_equal(weight, 1)
    certain = lifter.lift(points, np.ones(points.shape[:2], np.float32))
    low = lifter.lift(points, np.full(points.shape[:2], 0.25, np.float32))
    np.testing.assert_array_equal(low.shapes, certain.shapes)


def test_files_leave_out_the_border_and_say_so(tmp_path: Path) -> None:
    points = people(3)
    points[1:, LEGS, 1] = 719
    np.savez(tmp_path / "keypoints.npz", points=points)
    options = ReadOptions(image_size=(1280, 720), layout=HUMAN17)
    detections = read_keypoints(tmp_path / "keypoints.npz", options)
    assert not detections.confidence[1:, LEGS].any() and detections.confidence[0].all()
    assert "12 of 51 keypoints are at the border" in " ".join(map(str, detections.warnings))


def test_a_file_with_many_keypoints_outside_is_of_another_image(tmp_path: Path) -> None:
    np.savez(tmp_path / "keypoints.npz", points=people(3))
    options = ReadOptions(image_size=(720, 400), layout=HUMAN17)
    detections = read_keypoints(tmp_path / "keypoints.npz", options)
    assert detections.confidence.all() and not detections.warnings
    # Fractions are multiplied by the size: those beyond 1 are legs that the image cuts off.
    np.savez(tmp_path / "keypoints.npz", points=people(3) / (720, 400))
    detections = read_keypoints(tmp_path / "keypoints.npz", options)
    assert detections.is_normalised and not detections.confidence[:, LEGS[-1]].any()


def test_few_keypoints_at_the_border_are_no_warning(tmp_path: Path) -> None:
    points = people(20)
    points[7, LEGS[:2], 1] = 719
    np.savez(tmp_path / "keypoints.npz", points=points)
    options = ReadOptions(image_size=(1280, 720), layout=HUMAN17)
    detections = read_keypoints(tmp_path / "keypoints.npz", options)
    assert not detections.warnings
    assert "2 of 340 keypoints are at the border" in detections.notes[0]


def test_a_weight_grows_with_the_score() -> None:
    scores = np.linspace(0, 1, 21)
    confidence = np.full((21, 17), 0.9)
    confidence[:, 0] = scores
    weight = keypoint_weight(confidence)[:, 0]
    assert (np.diff(weight) >= 0).all() and weight[0] == 0 and weight[-1] == 1
    assert weight[4] < 1e-3 and not trusted(weight[4]) and trusted(weight[15])


def test_head_and_shoulders_with_guessed_legs_are_nobody() -> None:
    confidence = np.full((1, 17), 0.15, np.float32)
    confidence[:, [HUMAN17.index(k) for k in ("nose", "left_shoulder", "right_shoulder")]] = 0.9
    assert np.isnan(Lifter(HUMAN).lift(people(1), confidence).shapes).all()


def test_a_guess_does_not_move_the_place() -> None:
    camera = Intrinsics((1000.0, 1000.0), (640.0, 360.0))
    points = people(5)
    confidence = np.full(points.shape[:2], 0.9, np.float32)
    confidence[:, LEGS] = 0
    expected = lift_perspective(Lifter(HUMAN), camera, points, confidence).shapes[:, REST]
    confidence[:, LEGS], points[:, LEGS] = 0.15, (600, 320)
    found = lift_perspective(Lifter(HUMAN), camera, points, confidence).shapes[:, REST]
    assert np.abs(found - expected).max() < 0.1 * expected[..., 2].mean()


@pytest.mark.parametrize("size", [(1280, 720), (3840, 2160)])
def test_keypoints_at_the_border_are_missing(size: tuple[int, int]) -> None:
    w, h = size
    points = np.array(
        [[(w / 2, h / 2), (0.5, 9), (9, h - 1), (w + 50, 9), (9, -3), (w - 12, h - 12), (0, 0)]]
    ).astype(np.float32)
    confidence = np.array([[0.5] * 6 + [0]], np.float32)
    found = without_border(Observation(points, confidence, ("a",)), size)
    assert found.confidence.tolist() == [[0.5, 0, 0, 0, 0, 0.5, 0]]
    assert found.points[0, [1, 2, 3, 4]].tolist() == [[0, 0]] * 4
    assert found.identities == ("a",) and points[0, 3, 0] == w + 50
    inside = Observation(points[:, :1], confidence[:, :1])
    assert without_border(inside, size) is inside


def test_sure_keypoints_outside_the_image_are_counted() -> None:
    points, confidence = people(4), np.full((4, 17), 0.8, np.float32)
    assert outside_share(points, confidence, (1280, 720)) == 0
    points[:2, LEGS, 1] = 750
    share = outside_share(points, confidence, (1280, 720))
    assert share == pytest.approx(2 * len(LEGS) / (4 * 17))
    confidence[:2, LEGS] = 0.2  # what a detector guesses of legs that the image cuts off
    assert outside_share(points, confidence, (1280, 720)) == 0
    points[:, LEGS, 1], confidence[:] = 724, 0.8  # at the border
    assert outside_share(points, confidence, (1280, 720)) == 0
    assert outside_share(points, 0 * confidence, (1280, 720)) == 0


def test_the_size_of_another_image_leaves_nothing_out() -> None:
    observation = Observation(people(2), np.ones((2, 17), np.float32))
    assert without_border(observation, (160, 90)) is observation
