# SPDX-License-Identifier: Apache-2.0
"""Gravity sets an object upright that is nearly upright, and leaves one that lies."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from deep_nrsfm_ros.lifting.correction import ErrorModel, correct
from deep_nrsfm_ros.lifting.gravity import LEAN_DEVIATION, Upright
from deep_nrsfm_ros.nrsfm.geometry import centre

RNG = np.random.default_rng(0)
UP = np.array([0.0, -1, 0])
AXIS = np.array([1, 0, 0, 0, -0.5, -0.5])
CAMERA = np.eye(3)[None, :, :2]


def person(lean: float) -> np.ndarray:
    """Return a shape (1, 6, 3), in camera axes, that leans away from the camera by degrees."""
    S = np.array(
        [[0, -1, 0], [0.3, -0.9, 0], [-0.3, -0.9, 0.1], [0, 0, 0.1], [-0.2, 1, 0.0], [0.2, 1, 0]]
    )
    turned = Rotation.from_euler("x", -lean, degrees=True).apply(S)
    return centre(turned[None])


def lean_of(S: np.ndarray) -> float:
    v = AXIS @ S[0]
    return float(np.degrees(np.arccos(v @ UP / np.linalg.norm(v))))


def lifted(S: np.ndarray, up: np.ndarray) -> np.ndarray:
    errors = ErrorModel(0.05 * np.eye(18), None, Upright(AXIS, up[None]))
    return correct(S, CAMERA, S[..., :2], np.ones((1, 6)), errors, 0.01)


def test_the_constraint_is_the_component_across_gravity() -> None:
    X, up = RNG.standard_normal((3, 6, 3)), RNG.standard_normal((3, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    G, r, covariance = Upright(AXIS, up).constraint(X)
    v = AXIS @ X
    across = v - (v * up).sum(1, keepdims=True) * up
    np.testing.assert_allclose(np.linalg.norm(r, axis=1), np.linalg.norm(across, axis=1))
    np.testing.assert_allclose(r, -(G @ X.reshape(3, 18, 1))[..., 0], atol=1e-12)
    upright = Upright(AXIS, (v / np.linalg.norm(v, axis=1, keepdims=True))).constraint(X)
    np.testing.assert_allclose(upright[1], 0, atol=1e-12)
    deviation = np.sqrt(upright[2][:, 0, 0]) / np.linalg.norm(v, axis=1)
    np.testing.assert_allclose(deviation, LEAN_DEVIATION)


@pytest.mark.parametrize(("lean", "least", "most"), [(0, 0, 0.1), (12, 0, 6), (60, 55, 60)])
def test_who_leans_is_set_up_and_who_lies_is_left(lean: float, least: float, most: float) -> None:
    assert least <= lean_of(lifted(person(lean), UP)) <= most


def test_gravity_from_elsewhere_changes_little() -> None:
    S = person(3)
    moved = np.linalg.norm(lifted(S, np.array([1.0, 0, 0])) - S, axis=2).mean()
    assert moved < 0.05
