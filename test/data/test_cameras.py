# SPDX-License-Identifier: Apache-2.0
"""Cameras project and triangulate consistently, with missing and wrong views."""

import numpy as np
import pytest

from deep_nrsfm_ros.data.cameras import Camera, triangulate


@pytest.fixture
def cameras(ring: list[Camera]) -> list[Camera]:
    return [camera.without_lens() for camera in ring]


def person(frames: int = 3, joints: int = 12, seed: int = 0) -> np.ndarray:
    """Return (frames, joints, 3) points within a metre of the origin."""
    return np.random.default_rng(seed).uniform(-500, 500, (frames, joints, 3))


def test_lens_is_undone(ring: list[Camera]) -> None:
    camera = ring[0]
    bent, straight = camera.project(person()), camera.without_lens().project(person())
    assert np.abs(bent - straight).max() > 0.5
    np.testing.assert_allclose(camera.undistort(bent), straight, atol=1e-6)


def test_triangulation_inverts_projection(cameras: list[Camera]) -> None:
    world = person()
    pixels = np.stack([camera.project(world) for camera in cameras])
    points, residual = triangulate(cameras, pixels, np.ones(pixels.shape[:-1]))
    np.testing.assert_allclose(points, world, atol=1e-6)
    np.testing.assert_allclose(residual, 0, atol=1e-6)


def test_one_view_is_not_enough(cameras: list[Camera]) -> None:
    world = person()
    pixels, weights = np.stack([c.project(world) for c in cameras]), np.ones((4, 3, 12))
    pixels[0, 0, 0], weights[0, 0, 0] = 0, 0  # three views are left
    weights[1:, 0, 1] = 0  # one
    weights[:, 0, 2] = 0  # none
    points, residual = triangulate(cameras, pixels, weights)
    assert np.isnan(points[0, 1:3]).all() and np.isfinite(points).sum() == points.size - 6
    np.testing.assert_allclose(points[0, 0], world[0, 0], atol=1e-6)
    assert np.isnan(residual[0, 0, 0]).all() and np.isfinite(residual[1:, 0, 0]).all()


def test_a_wrong_view_hardly_moves_the_point(cameras: list[Camera]) -> None:
    world = person()
    pixels = np.stack([camera.project(world) for camera in cameras])
    pixels[2, 1, 5] += (150, -80)
    weights = np.ones(pixels.shape[:-1])
    robust, _ = triangulate(cameras, pixels, weights)
    plain, _ = triangulate(cameras, pixels, weights, rounds=1)
    moved = [np.linalg.norm(points[1, 5] - world[1, 5]) for points in (robust, plain)]
    assert moved[0] < 0.35 * moved[1] and moved[1] == pytest.approx(100, rel=0.6)
