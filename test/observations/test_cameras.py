"""Cameras project and triangulate consistently, with missing and wrong views."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from deep_nrsfm_ros.observations.cameras import Camera, triangulate


def ring(count: int = 4, lens: bool = False) -> list[Camera]:
    """Return cameras on a circle of 3 m, 1 m up, that look at the origin of a z-up world in mm."""
    cameras = []
    for i in range(count):
        around = Rotation.from_euler("z", 360 * i / count + 20, degrees=True).as_matrix()
        down = Rotation.from_euler("x", 20, degrees=True).as_matrix()
        rotation = down @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ around
        cameras.append(
            Camera(
                f"cam{i + 1:02}",
                np.array([[1700.0, 0, 540], [0, 1690, 950], [0, 0, 1]]),
                np.array([-0.05, 0.14, 0.0006, 0.0007]) if lens else np.zeros(4),
                rotation,
                np.array([0.0, 0, 3200]),
                (1088, 1920),
            )
        )
    return cameras


def person(frames: int = 3, joints: int = 12, seed: int = 0) -> np.ndarray:
    """Return (frames, joints, 3) points within a metre of the origin."""
    return np.random.default_rng(seed).uniform(-500, 500, (frames, joints, 3))


def test_lens_is_undone() -> None:
    (camera,) = ring(1, lens=True)
    bent, straight = camera.project(person()), camera.without_lens().project(person())
    assert np.abs(bent - straight).max() > 0.5
    np.testing.assert_allclose(camera.undistort(bent), straight, atol=1e-6)


def test_triangulation_inverts_projection() -> None:
    cameras, world = ring(), person()
    pixels = np.stack([camera.project(world) for camera in cameras])
    points, residual = triangulate(cameras, pixels, np.ones(pixels.shape[:-1]))
    np.testing.assert_allclose(points, world, atol=1e-6)
    np.testing.assert_allclose(residual, 0, atol=1e-6)


def test_one_view_is_not_enough() -> None:
    cameras, world = ring(), person()
    pixels, weights = np.stack([c.project(world) for c in cameras]), np.ones((4, 3, 12))
    pixels[0, 0, 0], weights[0, 0, 0] = 0, 0  # three views are left
    weights[1:, 0, 1] = 0  # one
    weights[:, 0, 2] = 0  # none
    points, residual = triangulate(cameras, pixels, weights)
    assert np.isnan(points[0, 1:3]).all() and np.isfinite(points).sum() == points.size - 6
    np.testing.assert_allclose(points[0, 0], world[0, 0], atol=1e-6)
    assert np.isnan(residual[0, 0, 0]).all() and np.isfinite(residual[1:, 0, 0]).all()


def test_a_wrong_view_hardly_moves_the_point() -> None:
    cameras, world = ring(), person()
    pixels = np.stack([camera.project(world) for camera in cameras])
    pixels[2, 1, 5] += (150, -80)
    weights = np.ones(pixels.shape[:-1])
    robust, _ = triangulate(cameras, pixels, weights)
    plain, _ = triangulate(cameras, pixels, weights, rounds=1)
    moved = [np.linalg.norm(points[1, 5] - world[1, 5]) for points in (robust, plain)]
    assert moved[0] < 0.35 * moved[1] and moved[1] == pytest.approx(100, rel=0.6)
