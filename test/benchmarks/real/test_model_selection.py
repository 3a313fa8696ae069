# SPDX-License-Identifier: Apache-2.0
"""Where joints are, told of people of known proportions; a camera sees what is before it."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.real import model_selection
from benchmarks.real.model_selection import CAMERA, facing_trunks, proportions, simulate_camera
from benchmarks.robustness.smoothing import Clip
from deep_nrsfm_ros.data.pose2sim import JOINTS
from deep_nrsfm_ros.layouts.presets import HUMAN17

# Shoulders 0.8 torso lengths apart, hips 0.5; the nose 0.4 above the neck.
TRUNK = np.array([[40, 100], [-40, 100], [25, 200], [-25, 200], [7, 60]], float)


def test_proportions_do_not_depend_on_size_and_place() -> None:
    X = np.stack([TRUNK, 3 * TRUNK + 50])
    assert proportions(X) == pytest.approx({"hips": 0.5, "shoulders": 0.8, "nose": 0.4})
    assert "nose" not in proportions(X[:, :4])


def test_only_who_faces_the_camera_surely_is_measured() -> None:
    points, confidence = np.zeros((3, 17, 2)), np.ones((3, 17))
    places = [HUMAN17.index(joint) for joint in model_selection._TRUNK]
    points[:, places] = TRUNK
    points[1, places] *= [0.5, 1]  # seen from the side
    confidence[2, places[0]] = 0.3
    found = facing_trunks(Clip(points, confidence, 30.0))
    np.testing.assert_array_equal(found, TRUNK[None])


def test_a_camera_sees_the_truth_but_for_the_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model_selection, "NOISE", 0.0)
    rng = np.random.default_rng(0)
    shapes = 0.4 * rng.standard_normal((20, 17, 3))
    simulate_clip = simulate_camera(shapes, rng)
    limbs = [HUMAN17.index(joint) for joint in JOINTS]
    pixels = CAMERA.pixels(simulate_clip.truth[..., :2] / simulate_clip.truth[..., 2:])
    np.testing.assert_allclose(simulate_clip.points[:, limbs], pixels, atol=1e-2)
    assert 0 < (simulate_clip.confidence == 0).mean() < 0.15
    gaps = np.linalg.norm(shapes[:, limbs[0]] - shapes[:, limbs[5]], axis=1)
    found = np.linalg.norm(simulate_clip.truth[:, 0] - simulate_clip.truth[:, 5], axis=1)
    np.testing.assert_allclose(found, 1000 * gaps, rtol=1e-6)
