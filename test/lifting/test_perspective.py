# SPDX-License-Identifier: Apache-2.0
"""Objects come out at their position, turned as the camera sees them, wherever they stand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.lifting.intrinsics import EQUIDISTANT, Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.lifting.perspective import lift_perspective, virtual_views
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser

P = len(HUMAN17)
LENS = Intrinsics((600.0, 620.0), (320.0, 240.0), (-0.2, 0.05, 0.001, -0.001, 0.0))
CERTAIN = np.ones((1, P), np.float32)
sides = st.floats(-0.6, 0.6)


@pytest.fixture(scope="module")
def lifter() -> Lifter:
    network = initialise(Architecture((12, 6)), P, np.random.default_rng(0))
    model = Model("random", network, HUMAN17, Normaliser(), np.eye(3, dtype=np.float32))
    return Lifter(model, LiftingOptions(reference_length=0.5, noise=0))


@pytest.fixture
def pixels() -> np.ndarray:
    return np.random.default_rng(0).uniform(100, 500, (3, P, 2)).astype(np.float32)


def turn_to(position: np.ndarray) -> np.ndarray:
    """Return the least rotation (3, 3) of the optical axis to the ray through `position`."""
    ray = position / np.linalg.norm(position)
    across = np.cross([0, 0, 1], ray)
    length = np.linalg.norm(across)
    vector = across * (np.arctan2(length, ray[2]) / length) if length else across
    turn: np.ndarray = Rotation.from_rotvec(vector).as_matrix()
    return turn


def seen(shapes: np.ndarray) -> np.ndarray:
    return LENS.pixels(shapes[..., :2] / shapes[..., 2:]).astype(np.float32)


@settings(max_examples=25, deadline=None)
@given(x=sides, y=sides, far=st.floats(150, 600))
def test_an_object_comes_out_at_its_place_and_turned_with_its_ray(
    lifter: Lifter, x: float, y: float, far: float
) -> None:
    # So far away that perspective is weak, and an object that the lifter lifts to itself.
    flat = np.random.default_rng(1).uniform(-1, 1, (1, P, 2)).astype(np.float32)
    centred = lifter(flat, CERTAIN)
    position = far * np.array([x, y, 1])
    Q = turn_to(position)
    shape = centred.shapes @ Q.T + position
    lifted = lift_perspective(lifter, LENS, seen(shape), CERTAIN)
    assert np.linalg.norm(lifted.shapes.mean(1) - position) < 0.02 * np.linalg.norm(position)
    size = np.abs(centred.shapes).max()
    form = lifted.shapes - lifted.shapes.mean(1, keepdims=True)
    np.testing.assert_allclose(form, centred.shapes @ Q.T, atol=0.05 * size)
    np.testing.assert_allclose(lifted.rotations, Q @ centred.rotations, atol=0.05)
    W = lifted.scale[:, None, None] * lifted.shapes[..., :2] + lifted.translation[:, None]
    assert np.abs(W - seen(shape)).max() < 0.5 * np.ptp(seen(shape), axis=1).max()


def test_what_comes_out_is_seen_where_the_keypoints_are(lifter: Lifter) -> None:
    """By the perspective camera itself, lens and all, of objects as near as two metres."""
    rng = np.random.default_rng(3)
    pixels = (rng.uniform(0, 150, (20, P, 2)) + rng.uniform(0, 400, (20, 1, 2))).astype(np.float32)
    confidence = (rng.random((20, P)) > 0.2).astype(np.float32)
    lifted = lift_perspective(lifter, LENS, pixels, confidence)
    ahead = np.all(lifted.shapes[..., 2] > 0, axis=1)  # a random model may put points anywhere
    assert ahead.sum() > 10
    known = (confidence > 0) & ahead[:, None]
    np.testing.assert_allclose(seen(lifted.shapes)[known], pixels[known], atol=0.5)


def test_the_reference_length_sets_size_and_distance_alike(
    lifter: Lifter, pixels: np.ndarray
) -> None:
    confidence = np.ones(pixels.shape[:2], np.float32)
    twice = Lifter(lifter.model, LiftingOptions(reference_length=1.0, noise=0))
    one = lift_perspective(lifter, LENS, pixels, confidence)
    two = lift_perspective(twice, LENS, pixels, confidence)
    np.testing.assert_allclose(two.shapes, 2 * one.shapes, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(two.rotations, one.rotations, atol=1e-5)
    neck, hip = HUMAN17.index("neck"), HUMAN17.index("mid_hip")
    length = np.linalg.norm(one.shapes[:, neck] - one.shapes[:, hip], axis=1)
    np.testing.assert_allclose(length, 0.5, rtol=1e-3)


def test_a_camera_turned_towards_the_object_sees_it_in_the_middle() -> None:
    shape = np.random.default_rng(0).normal(0, 0.1, (3, 8, 3)) + [[[1, -0.5, 3]]]
    points, confidence = seen(shape), np.ones((3, 8), np.float32)
    confidence[1, :2] = 0
    views = virtual_views(LENS, points, confidence)
    orthonormal = views.rotations @ views.rotations.swapaxes(1, 2)
    np.testing.assert_allclose(orthonormal, np.tile(np.eye(3), (3, 1, 1)), atol=1e-12)
    inside = shape @ views.rotations.swapaxes(1, 2)
    flat = inside[..., :2] / inside[..., 2:]
    known = confidence > 0
    np.testing.assert_allclose(views.points[known], flat[known], atol=1e-5)
    assert not views.points[~known].any()
    assert np.abs((views.points * known[..., None]).sum(1) / known.sum(1)[:, None]).max() < 0.01


def test_pixels_without_a_ray_are_missing() -> None:
    fisheye = Intrinsics((300.0, 300.0), (500.0, 500.0), (), EQUIDISTANT)
    # At 0, 20, 115 and 57 degrees from the axis.
    points = np.array([[[500, 500], [605, 500], [500, 1100], [200, 500]]], np.float32)
    views = virtual_views(fisheye, points, np.ones((1, 4), np.float32))
    np.testing.assert_array_equal(views.confidence, [[1, 1, 0, 1]])
    assert np.isfinite(views.points).all()
    nothing = virtual_views(fisheye, points[:, 2:3], np.ones((1, 1), np.float32))
    np.testing.assert_array_equal(nothing.rotations, np.eye(3)[None])


def test_what_cannot_be_lifted_is_nan_and_touches_nothing(
    lifter: Lifter, pixels: np.ndarray
) -> None:
    confidence = np.ones((3, P), np.float32)
    alone = lift_perspective(lifter, LENS, pixels[[0, 2]], confidence[[0, 2]])
    confidence[1, 2:] = 0
    lifted = lift_perspective(lifter, LENS, pixels, confidence)
    assert np.isnan(lifted.shapes[1]).all() and not lifted.confidence[1].any()
    assert np.isnan(lifted.residual[1])
    np.testing.assert_allclose(lifted.shapes[[0, 2]], alone.shapes, rtol=1e-4, atol=1e-4)
