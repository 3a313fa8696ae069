# SPDX-License-Identifier: Apache-2.0
"""The supervised methods: exact where the pose is an atom, or a combination of few."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from benchmarks.baselines.pose_dictionary import (
    JOINTS15,
    LIMBS15,
    class_dictionary,
    mean_deviation,
    normalised_poses,
    sparse_dictionary,
)
from benchmarks.baselines.pursuit import limb_coefficients, pursue
from benchmarks.baselines.single_view import (
    alternate,
    convex,
    convex_refined,
    one_rotation,
    scaled_images,
)
from deep_nrsfm_ros.layouts.presets import CMU31
from deep_nrsfm_ros.nrsfm.geometry import align, centre, random_cameras
from deep_nrsfm_ros.nrsfm.metrics import shape_errors

Solver = Callable[[np.ndarray, np.ndarray], np.ndarray]
P = len(JOINTS15)


@pytest.fixture(scope="module")
def atoms() -> np.ndarray:
    """A dictionary (4, 3, 15) with atoms of the norm of a pose."""
    B = np.random.default_rng(0).standard_normal((4, 3, P))
    B -= B.mean(2, keepdims=True)
    return 7 * B / np.linalg.norm(B, axis=(1, 2), keepdims=True)


def images(S: np.ndarray, seed: int = 1) -> np.ndarray:
    return S @ random_cameras(len(S), np.random.default_rng(seed)).astype(float)


def test_joints_and_limbs_are_of_motion_capture() -> None:
    assert set(JOINTS15) <= set(CMU31.keypoints)
    assert {i for limb in LIMBS15 for i in limb} == set(range(P))
    assert len(LIMBS15) == P - 1


def test_poses_have_one_unit_and_the_torso_of_the_first() -> None:
    rng = np.random.default_rng(0)
    S = rng.standard_normal((20, P, 3)) + 3
    turned = np.linalg.qr(rng.standard_normal((20, 3, 3)))[0]
    turned *= np.linalg.det(turned)[:, None, None]
    S[1:] = S[0]
    poses = normalised_poses(5 * S @ turned)
    assert mean_deviation(poses) == pytest.approx(1, rel=0.05)  # axes turn
    np.testing.assert_allclose(poses, np.broadcast_to(poses[0], poses.shape), atol=1e-9)


def test_dictionary_explains_poses_by_few_atoms(atoms: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    poses = np.repeat(atoms, 20, 0).swapaxes(1, 2)[rng.permutation(80)]
    B = sparse_dictionary(poses, 8, 0.1)
    correlation = np.einsum("kcp,lcp->kl", B, atoms) / 49
    assert correlation.max(0).min() > 0.9  # 0.94 to 0.99, by how the processor rounds
    assert np.linalg.norm(B, axis=(1, 2)).max() < 7 + 1e-9


def test_classes_have_their_principal_components() -> None:
    rng = np.random.default_rng(0)
    mean, mode = rng.standard_normal((2, 3, P))
    poses = (mean + rng.standard_normal((50, 1, 1)) * mode).swapaxes(1, 2)
    centre_pose, B = class_dictionary(poses, 1)
    assert len(B) == 1
    assert abs((B[0] * mode).sum()) == pytest.approx(np.linalg.norm(mean * 0 + mode), rel=1e-6)
    np.testing.assert_allclose(centre_pose.T, poses.mean(0))


@pytest.mark.parametrize(
    ("solver", "limit"),
    [
        (partial(convex, sparsity=0.01), 0.02),
        (partial(convex_refined, sparsity=0.01), 0.02),
        (partial(convex, sparsity=1.0), 0.1),
    ],
)
def test_pose_that_is_an_atom_is_found(solver: Solver, limit: float, atoms: np.ndarray) -> None:
    shapes = np.repeat(atoms.swapaxes(1, 2), 10, 0)
    assert shape_errors(solver(images(shapes), atoms), shapes).shape < limit


def test_alternate_is_exact_from_a_start_that_is_near(atoms: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    codes = 1 + 0.2 * rng.standard_normal((40, 4))
    shapes = np.einsum("fk,kcp->fpc", codes, atoms)
    found = alternate(images(shapes), atoms, sparsity=1e-4)
    assert np.median(np.linalg.norm(_aligned(found, shapes) - shapes, axis=(1, 2))) < 0.3


def _aligned(S: np.ndarray, T: np.ndarray) -> np.ndarray:
    S = S * (np.linalg.norm(T, axis=(1, 2)) / np.linalg.norm(S, axis=(1, 2)))[:, None, None]
    return align(S, T, allow_reflection=True).aligned


@pytest.mark.parametrize("mirror", [1, -1])
def test_one_rotation_is_that_of_all_atoms(mirror: int) -> None:
    rng = np.random.default_rng(0)
    R = random_cameras(5, rng).astype(float).swapaxes(1, 2) * np.array([[1], [mirror]])
    c = rng.standard_normal((5, 6))
    found, codes = one_rotation(c[..., None, None] * R[:, None])
    np.testing.assert_allclose(
        codes[..., None, None] * found[:, None], c[..., None, None] * R[:, None], atol=1e-6
    )
    assert (np.take_along_axis(codes, np.abs(codes).argmax(1)[:, None], 1) > 0).all()


def test_images_have_a_deviation_of_one() -> None:
    Y = scaled_images(np.random.default_rng(0).standard_normal((5, P, 2)) * 9 + 4)
    np.testing.assert_allclose(Y.std(2).mean(1), 1)


def test_coefficients_keep_the_lengths_of_limbs_in_sum() -> None:
    rng = np.random.default_rng(0)
    mean, B = rng.standard_normal((3, P)), 0.3 * rng.standard_normal((4, 3, P))
    M = random_cameras(1, rng)[0].T.astype(float)
    target = mean + np.tensordot(rng.standard_normal(4), B, 1)
    left = M @ (target - mean)
    a = limb_coefficients(left - left.mean(1, keepdims=True), M, mean, B, LIMBS15)
    i, j = np.array(LIMBS15).T

    def length(X: np.ndarray) -> float:
        return float(((X[:, i] - X[:, j]) ** 2).sum())

    assert length(mean + np.tensordot(a, B, 1)) == pytest.approx(length(mean), rel=1e-6)


def test_pursuit_finds_a_pose_of_few_atoms() -> None:
    rng = np.random.default_rng(0)
    mean = rng.standard_normal((3, P))
    mean -= mean.mean(1, keepdims=True)
    B = rng.standard_normal((6, 3, P))
    B -= B.mean(2, keepdims=True)
    B /= np.linalg.norm(B, axis=(1, 2), keepdims=True)
    i, j = np.array(LIMBS15).T
    poses = []
    for k in range(3):
        # The multiple of the atom that keeps the squared lengths of the limbs in sum.
        limb, step = mean[:, i] - mean[:, j], B[k][:, i] - B[k][:, j]
        poses.append(mean - 2 * (limb * step).sum() / (step**2).sum() * B[k])
    S = np.stack(poses).swapaxes(1, 2)
    found = pursue(images(S), mean, B, several_starts=True)
    assert (
        np.median([shape_errors(f[None], s[None]).shape for f, s in zip(found, S, strict=True)])
        < 0.05
    )
    first = pursue(images(centre(mean.T)[None]), mean, B)
    assert shape_errors(first, mean.T[None]).shape < 0.02
