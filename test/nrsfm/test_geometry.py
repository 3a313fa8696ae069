# SPDX-License-Identifier: Apache-2.0
"""Cameras and alignment against NumPy's and SciPy's own, and their invariants."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros.nrsfm.geometry import (
    align,
    back_project,
    centre,
    on_one_line,
    polar,
    quaternion,
    random_cameras,
    reprojection_error,
    rotation_from_camera,
    rotation_from_vector,
    rotation_vector,
    spectral_norm,
    weak_perspective,
)

some = settings(max_examples=30, deadline=None)
seeds = st.integers(0, 2**32 - 1)


def random_rotations(n: int, rng: np.random.Generator) -> np.ndarray:
    return rotation_from_camera(np.linalg.qr(rng.standard_normal((n, 3, 2)))[0])


def polar_by_svd(A: np.ndarray) -> np.ndarray:
    U, _, Vt = np.linalg.svd(A, full_matrices=False)
    return U @ Vt


@some
@given(seeds, st.floats(-4, 4))
def test_polar_is_the_svds_whatever_the_size(seed: int, magnitude: float) -> None:
    A = np.random.default_rng(seed).standard_normal((20, 2, 3)) * 10**magnitude
    A = A[np.linalg.cond(A) < 100]
    np.testing.assert_allclose(polar(A), polar_by_svd(A), atol=1e-5)
    single = A.astype(np.float32)
    assert polar(single).dtype == np.float32
    np.testing.assert_allclose(polar(single), polar_by_svd(single), atol=1e-3)
    np.testing.assert_allclose(polar(torch.from_numpy(A)).numpy(), polar(A), atol=1e-9)


@pytest.mark.parametrize("angle", [1e-1, 1e-2, 1e-3])
def test_polar_of_nearly_parallel_rows(angle: float) -> None:
    R = random_rotations(200, np.random.default_rng(0))
    A = np.stack([R[:, 0], R[:, 0] + angle * R[:, 1]], 1)
    np.testing.assert_allclose(polar(A), polar_by_svd(A), atol=1e-5)
    P = polar(A.astype(np.float32))
    np.testing.assert_allclose(P @ P.swapaxes(1, 2), np.tile(np.eye(2), (200, 1, 1)), atol=1e-3)


@pytest.mark.parametrize("A", [np.zeros((2, 3)), np.ones((2, 3)), np.eye(2, 3) * [[1], [0]]])
def test_polar_without_rank_is_finite_and_so_is_its_gradient(A: np.ndarray) -> None:
    assert np.isfinite(polar(A)).all()
    tensor = torch.tensor(A, dtype=torch.float32, requires_grad=True)
    polar(tensor).sum().backward()
    assert tensor.grad is not None and torch.isfinite(tensor.grad).all()


@some
@given(seeds)
def test_spectral_norm_is_the_largest_singular_value(seed: int) -> None:
    A = np.random.default_rng(seed).standard_normal((10, 2, 3))
    np.testing.assert_allclose(spectral_norm(A), np.linalg.norm(A, 2, (1, 2)), atol=1e-5)


def test_random_cameras_are_orthonormal_uniform_and_fixed_by_their_seed() -> None:
    n = 20000
    M = random_cameras(n, np.random.default_rng(0))
    assert M.shape == (n, 3, 2) and M.dtype == np.float32
    np.testing.assert_allclose(M.swapaxes(1, 2) @ M, np.tile(np.eye(2), (n, 1, 1)), atol=1e-4)
    axes = rotation_from_camera(M)  # uniform rotations: no axis prefers a direction
    np.testing.assert_allclose(axes.mean(0), 0, atol=0.02)
    for axis in range(3):
        directions = axes[:, axis]
        np.testing.assert_allclose(directions.T @ directions / n, np.eye(3) / 3, atol=0.02)
        # Archimedes: each coordinate of a uniform direction is uniform.
        for coordinate in np.sort(directions.T):
            np.testing.assert_allclose(coordinate, np.linspace(-1, 1, n), atol=0.03)
    np.testing.assert_array_equal(M, random_cameras(n, np.random.default_rng(0)))


@some
@given(seeds, st.floats(0, 1))
def test_back_projection_meets_the_image_and_moves_nothing_in_depth(
    seed: int, share: float
) -> None:
    rng = np.random.default_rng(seed)
    S, W = rng.standard_normal((5, 9, 3)), rng.standard_normal((5, 9, 2))
    R = random_rotations(5, rng)
    M = R[:, :2].swapaxes(1, 2)
    np.testing.assert_allclose(back_project(S, M, W) @ M, W, atol=1e-12)
    part = back_project(S, M, W, share)
    np.testing.assert_allclose(part @ M, share * W + (1 - share) * (S @ M), atol=1e-12)
    depth = R[:, 2, :, None]
    np.testing.assert_allclose(part @ depth, S @ depth, atol=1e-12)


@some
@given(seeds)
def test_the_depth_mirror_of_a_shape_looks_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    S, R = rng.standard_normal((9, 3)), random_rotations(1, rng)[0]
    M, r3 = R[:2].T, R[2]
    mirrored = S @ (np.eye(3) - 2 * np.outer(r3, r3))
    np.testing.assert_allclose(mirrored @ M, S @ M, atol=1e-12)
    assert np.abs(align(S, mirrored).aligned - mirrored).max() > 1e-3
    assert align(S, mirrored, allow_reflection=True).mirrored


@some
@given(seeds, st.booleans())
def test_align_recovers_a_rotation(seed: int, allow_reflection: bool) -> None:
    rng = np.random.default_rng(seed)
    X, Q = rng.standard_normal((4, 7, 3)), random_rotations(4, rng)
    aligned, rotation, mirrored = align(X, X @ Q, allow_reflection=allow_reflection)
    np.testing.assert_allclose(aligned, X @ Q, atol=1e-9)
    np.testing.assert_allclose(rotation, Q, atol=1e-9)
    assert not mirrored.any()


@some
@given(seeds)
def test_align_reflects_only_if_allowed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    X, Q = rng.standard_normal((4, 7, 3)), -random_rotations(4, rng)
    free = align(X, X @ Q, allow_reflection=True)
    np.testing.assert_allclose(free.aligned, X @ Q, atol=1e-9)
    assert free.mirrored.all()
    proper = align(X, X @ Q)
    np.testing.assert_allclose(np.linalg.det(proper.rotation), 1)
    assert not proper.mirrored.any()
    error = np.linalg.norm(proper.aligned - X @ Q, axis=(1, 2))
    for other in random_rotations(50, rng):  # no rotation does better
        assert (np.linalg.norm(X @ other - X @ Q, axis=(1, 2)) >= error - 1e-9).all()


def masks(rng: np.random.Generator, n: int, p: int, at_least: int) -> np.ndarray:
    visible = rng.random((n, p)) < 0.6
    visible[:, :at_least] = True
    return visible


@some
@given(seeds, st.floats(0.01, 500), st.floats(-1000, 1000))
def test_weak_perspective_recovers_scale_and_translation(
    seed: int, scale: float, shift: float
) -> None:
    rng = np.random.default_rng(seed)
    P = rng.standard_normal((6, 9, 2))
    visible = masks(rng, 6, 9, 2)
    W = scale * P + [shift, -2 * shift]
    W[~visible] = 1e4  # whatever a missing point holds
    found = weak_perspective(W, P, visible)
    np.testing.assert_allclose(found.scale, scale, rtol=1e-6)
    np.testing.assert_allclose(found.translation, [[shift, -2 * shift]] * 6, atol=1e-5)
    np.testing.assert_allclose(reprojection_error(W, P, visible), 0, atol=1e-5)


@some
@given(seeds)
def test_weak_perspective_is_the_least_squares_fit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    W, P = rng.standard_normal((2, 9, 2))
    visible = masks(rng, 1, 9, 3)[0]
    rows = np.zeros((2 * visible.sum(), 3))
    rows[:, 0] = P[visible].ravel()
    rows[0::2, 1] = rows[1::2, 2] = 1
    solution, (squares,), *_ = np.linalg.lstsq(rows, W[visible].ravel(), rcond=None)
    found = weak_perspective(W, P, visible)
    np.testing.assert_allclose([found.scale, *found.translation], solution, atol=1e-6)
    relative = squares**0.5 / np.linalg.norm(centre(W[visible]))
    assert reprojection_error(W, P, visible) == pytest.approx(relative, abs=1e-6)


@some
@given(seeds)
def test_reprojection_error_of_a_mask_is_that_of_the_points_alone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    W, P = rng.standard_normal((2, 9, 2))
    visible = masks(rng, 1, 9, 3)[0]
    alone = reprojection_error(W[visible], P[visible], np.ones(visible.sum(), bool))
    assert reprojection_error(W, P, visible) == pytest.approx(alone, abs=1e-9)
    assert 0.01 < alone <= 1 + 1e-9


def test_nothing_visible_is_finite() -> None:
    W, nothing = np.ones((2, 5, 2)), np.zeros((2, 5), bool)
    for values in (*weak_perspective(W, W, nothing), reprojection_error(W, W, nothing)):
        assert np.isfinite(values).all()


def matrix(q: np.ndarray) -> np.ndarray:
    """Return the rotation of a unit quaternion (x, y, z, w): v + 2 u x (u x v + w v)."""
    K = np.array([[0, -q[2], q[1]], [q[2], 0, -q[0]], [-q[1], q[0], 0]])
    return np.eye(3) + 2 * (q[3] * K + K @ K)


def half_turns(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return rotations by 180 degrees and by almost as much, about every kind of axis."""
    axes = np.concatenate([np.eye(3), -np.eye(3), rng.standard_normal((n, 3))])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.pi - 10.0 ** -rng.integers(1, 12, len(axes))
    angles[::2] = np.pi
    half = angles[:, None] / 2
    return np.array([matrix(q) for q in np.concatenate([axes * np.sin(half), np.cos(half)], 1)])


@pytest.mark.parametrize("make", [random_rotations, half_turns])
def test_quaternion(make: Callable[[int, np.random.Generator], np.ndarray]) -> None:
    for R in make(200, np.random.default_rng(0)):
        q = quaternion(R)
        assert np.linalg.norm(q) == pytest.approx(1) and q[3] >= 0
        np.testing.assert_allclose(matrix(q), R, atol=1e-9)
        np.testing.assert_allclose(matrix(quaternion(R.astype(np.float32))), R, atol=1e-5)
    np.testing.assert_allclose(quaternion(np.eye(3)), [0, 0, 0, 1])


@pytest.mark.parametrize("make", [random_rotations, half_turns])
def test_rotation_vector_and_back(make: Callable[[int, np.random.Generator], np.ndarray]) -> None:
    for R in make(100, np.random.default_rng(2)):
        v = rotation_vector(R)
        assert np.linalg.norm(v) < np.pi + 1e-9
        np.testing.assert_allclose(rotation_from_vector(v), R, atol=1e-8)


@pytest.mark.parametrize("angle", [0.0, 1e-13, 1e-7, 1e-3, 1.0, 3.1])
def test_rotation_vector_is_axis_times_angle(angle: float) -> None:
    v = angle * np.array([0.6, 0.0, 0.8])
    np.testing.assert_allclose(rotation_vector(rotation_from_vector(v)), v, atol=1e-15, rtol=1e-9)


def test_quaternion_is_scipys() -> None:
    rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    for R in random_rotations(100, np.random.default_rng(1)):
        expected = rotation.from_matrix(R).as_quat()
        expected *= np.sign(expected[3])
        np.testing.assert_allclose(quaternion(R), expected, atol=1e-9)


def test_rotation_from_camera_is_proper() -> None:
    M = random_cameras(100, np.random.default_rng(0))
    R = rotation_from_camera(M)
    np.testing.assert_array_equal(R[:, :2], M.swapaxes(1, 2))
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.tile(np.eye(3), (100, 1, 1)), atol=1e-4)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-4)


def test_on_one_line_sees_lines_and_spots_among_the_visible_points_only() -> None:
    rng = np.random.default_rng(0)
    line = rng.normal(size=(9, 1)) * [3, 4] + [200, 100]
    W = np.stack((line, np.full((9, 2), 7.0), rng.normal(size=(9, 2)), line))
    visible = np.ones((4, 9), bool)
    W[3, 0] += [5, 0]
    assert on_one_line(W, visible).tolist() == [True, True, False, False]
    visible[3, 0] = False
    assert on_one_line(W, visible)[3]


def test_rotations_from_vectors_are_scipys() -> None:
    rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    vectors = np.random.default_rng(0).standard_normal((5, 4, 3))
    vectors *= np.array([0, 1e-13, 1e-6, 1, 10])[:, None, None]  # each row has one size
    expected = rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(5, 4, 3, 3)
    np.testing.assert_allclose(rotation_from_vector(vectors), expected, atol=1e-13)
    np.testing.assert_allclose(rotation_from_vector(vectors[3, 0]), expected[3, 0], atol=1e-13)
