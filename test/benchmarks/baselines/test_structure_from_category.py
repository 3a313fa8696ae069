# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from benchmarks.baselines.batches import lowest_errors
from benchmarks.baselines.spectral import depths, shrink_spectral_norm, singular_values
from benchmarks.baselines.structure_from_category import structure_from_category
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras, rotation_from_camera
from deep_nrsfm_ros.nrsfm.metrics import shape_errors

RNG = np.random.default_rng(0)


def test_shrinkage_is_that_of_the_singular_values() -> None:
    Q = np.concatenate([RNG.standard_normal((50, 2, 3)), np.zeros((1, 2, 3)), np.eye(3)[None, :2]])
    threshold = 0.7
    U, s, Vt = np.linalg.svd(Q, full_matrices=False)
    # Moreau: what remains of the projection on the ball of the nuclear norm.
    expected = []
    for large, small in s:
        if large + small <= threshold:
            expected.append((0.0, 0.0))
        elif large - small <= threshold:
            expected.append(((large + small - threshold) / 2,) * 2)
        else:
            expected.append((large - threshold, small))
    np.testing.assert_allclose(
        shrink_spectral_norm(Q, threshold), (U * np.array(expected)[:, None]) @ Vt, atol=1e-12
    )
    np.testing.assert_allclose(np.stack(singular_values(Q), 1), s, atol=1e-7)


def test_shrinkage_has_the_lowest_objective() -> None:
    Q = RNG.standard_normal((2, 3))
    X = shrink_spectral_norm(Q, 0.8)

    def objective(Y: np.ndarray) -> float:
        return 0.8 * float(np.linalg.norm(Y, 2)) + 0.5 * float(((Y - Q) ** 2).sum())

    others = [objective(X + 0.05 * RNG.standard_normal((2, 3))) for _ in range(200)]
    assert objective(X) < min(others)


def test_depth_is_that_of_the_rotated_shape() -> None:
    B, R = RNG.standard_normal((2, 3, 7)), random_cameras(10, RNG).astype(float)
    R = R.reshape(5, 2, 3, 2)
    c = RNG.uniform(0.1, 2, (5, 2))
    M = c[..., None, None] * R.swapaxes(-1, -2)
    expected = np.einsum("fk,fkc,kcp->fkp", c, rotation_from_camera(R)[..., 2, :], B)
    np.testing.assert_allclose(depths(M, B), expected, atol=1e-9)


@pytest.fixture(scope="module")
def rigid_views() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    S = centre(rng.standard_normal((15, 3)))
    return np.repeat(S[None], 60, 0), S @ random_cameras(60, rng).astype(float)


def test_one_basis_shape_without_sparsity_is_rigid_factorisation(
    rigid_views: tuple[np.ndarray, np.ndarray],
) -> None:
    shapes, points = rigid_views
    errors = [
        shape_errors(structure_from_category(points, 1, sparsity=weight)[0], shapes).unscaled
        for weight in (1e-3, 1e-1)
    ]
    assert errors[0] < 0.015 < errors[1]


def test_missing_points_are_found(rigid_views: tuple[np.ndarray, np.ndarray]) -> None:
    shapes, points = rigid_views
    visible = np.random.default_rng(1).random(points.shape[:2]) > 0.15
    spoilt = np.where(visible[..., None], points, np.nan)
    S = structure_from_category(spoilt, 1, sparsity=1e-2, visible=visible, growth=1.05)
    assert shape_errors(S[0], shapes).shape < 0.06


def test_all_sign_patterns_project_onto_the_same_images() -> None:
    rng = np.random.default_rng(0)
    mean, mode = rng.standard_normal((2, 12, 3))
    shapes = centre(mean + 0.5 * rng.standard_normal((80, 1, 1)) * mode)
    S = structure_from_category(shapes @ random_cameras(80, rng).astype(float), 3, growth=1.1)
    assert S.shape == (4, 80, 12, 3)
    assert np.ptp(S[..., :2], axis=0).max() == 0
    errors = [shape_errors(x, shapes).shape for x in S]
    assert lowest_errors(S, shapes).shape == min(errors) < max(errors)
