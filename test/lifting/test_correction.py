# SPDX-License-Identifier: Apache-2.0
"""The correction against the Gaussian formula written out, and the covariance against truth."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros.lifting.correction import ErrorModel, correct, error_covariance
from deep_nrsfm_ros.nrsfm.geometry import back_project, centre, random_cameras, rotation_from_camera

some = settings(max_examples=25, deadline=None)


def problem(p: int, seed: int) -> tuple[Any, ...]:
    """Return S, M, W, and a covariance, for one object."""
    rng = np.random.default_rng(seed)
    S, W = rng.standard_normal((1, p, 3)), rng.standard_normal((1, p, 2))
    B = rng.standard_normal((3 * p, 3 * p))
    return S, random_cameras(1, rng), W, B @ B.T + 0.1 * np.eye(3 * p)


@some
@given(st.integers(4, 8), st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.3]))
def test_it_is_the_conditional_mean_given_the_visible_points_up_to_a_translation(
    p: int, seed: int, noise: float
) -> None:
    S, M, W, covariance = problem(p, seed)
    visible = np.random.default_rng(seed).permutation(p) >= p // 3
    seen = np.flatnonzero(visible)
    H = np.zeros((2 * len(seen), 3 * p))
    for row, i in enumerate(seen):
        H[2 * row : 2 * row + 2, 3 * i : 3 * i + 3] = M[0].T
    # Differences to the first visible point know of no translation.
    D = np.kron(np.c_[-np.ones(len(seen) - 1), np.eye(len(seen) - 1)], np.eye(2))
    r = (W - S @ M)[0, seen].ravel()
    A, r, R = D @ H, D @ r, noise**2 * D @ D.T
    E = covariance @ A.T @ np.linalg.solve(A @ covariance @ A.T + R, r)
    found = correct(S, M, W, visible[None], ErrorModel(covariance), np.array([noise]))
    np.testing.assert_allclose(centre(found - S)[0], centre(E.reshape(p, 3)), atol=2e-2)


@some
@given(st.integers(4, 8), st.integers(0, 2**32 - 1))
def test_perspective_moves_each_point_onto_its_own_ray(p: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    S, M, _, covariance = problem(p, seed)
    R = rotation_from_camera(M)[0]
    depth, rays = 20.0, rng.uniform(-0.3, 0.3, (p, 2))
    cameras = M[:, None] - R[2][:, None] * rays[None, :, None]
    found = correct(S, cameras, depth * rays[None], np.ones((1, p), bool), ErrorModel(covariance))
    x, y, z = (found[0] @ R.T).T
    off = np.stack((x - rays[:, 0] * (z + depth), y - rays[:, 1] * (z + depth)), 1)
    np.testing.assert_allclose(off - off.mean(0), 0, atol=1e-2)


def test_equal_errors_everywhere_are_back_projection() -> None:
    S, M, W, _ = problem(7, 0)
    W = centre(W)
    found = correct(centre(S), M, W, np.ones((1, 7), bool), ErrorModel(np.eye(21)))
    np.testing.assert_allclose(found, back_project(centre(S), M, W), atol=1e-3)


def test_covariance_is_that_of_the_errors_made() -> None:
    """A network that knows the shape but for errors along one direction, by its input alone."""
    rng = np.random.default_rng(0)
    p, f = 6, 3000
    shape, direction = rng.standard_normal((2, p, 3))
    shape, direction = centre(shape), 0.1 * centre(direction)

    def lift(W: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        S = shape + rng.standard_normal((len(W), 1, 1)) * direction
        # The camera that shows `shape` as W.
        rows = np.linalg.lstsq(shape, W.transpose(1, 0, 2).reshape(p, -1), rcond=None)[0]
        M = rows.reshape(3, len(W), 2).transpose(1, 0, 2)
        U, _, Vt = np.linalg.svd(M, full_matrices=False)
        return S, U @ Vt, W

    found = error_covariance(lift, shape @ random_cameras(f, rng), rng)
    variance, axes = np.linalg.eigh(found)
    unit = direction.ravel() / np.linalg.norm(direction)
    assert abs(axes[:, -1] @ unit) > 0.99
    np.testing.assert_allclose(variance[-1], np.square(direction).sum(), rtol=0.1)
    assert variance[-1] > 10 * variance[-2] and variance[0] > 0


def test_depth_follows_what_is_seen(figure: Any) -> None:
    """Errors that hang together: the keypoints move a point along what they do not show."""
    p = 4
    E = np.zeros((p, 3))
    E[0] = [1, 0, 1]  # a point comes out wrong along x and z at once
    covariance = np.outer(E, E) + 1e-6 * np.eye(3 * p)
    S = np.random.default_rng(0).standard_normal((1, p, 3))
    M = np.eye(3)[None, :, :2]
    W = (S + 0.3 * E) @ M
    moved = correct(S, M, W, np.ones((1, p), bool), ErrorModel(covariance)) - S
    np.testing.assert_allclose(moved[0, 0] - moved[0, 1:].mean(0), [0.3, 0, 0.3], atol=0.01)
