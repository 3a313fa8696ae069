# SPDX-License-Identifier: Apache-2.0
"""Lengths of bones as observations: their derivatives, the formula, and what they are for."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros.lifting.correction import ErrorModel, bone_lengths, correct, varied_bones
from deep_nrsfm_ros.nrsfm.bones import Bones, relative_lengths
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras, rotation_from_camera

some = settings(max_examples=25, deadline=None)
seeds = st.integers(0, 2**32 - 1)
P = 6
EDGES = [(0, 1), (1, 2), (3, 2), (4, 5)]


def lengths(X: np.ndarray) -> np.ndarray:
    return np.stack([np.linalg.norm(X[..., i, :] - X[..., j, :], axis=-1) for i, j in EDGES], -1)


def bones_of(X: np.ndarray, spread: float = 0.02) -> Bones:
    """Return bones that have in X (p, 3) the lengths they should have."""
    share = lengths(X) / lengths(X).sum()
    return Bones(np.array(EDGES, np.int32).T, share, spread * share)


@some
@given(seeds)
def test_lengths_grow_as_their_derivatives_say(seed: int) -> None:
    rng = np.random.default_rng(seed)
    X, E = rng.standard_normal((2, 3, P, 3))
    G, _, _ = bones_of(X[0]).length_constraint(X)
    grown = (lengths(X + 1e-6 * E) - lengths(X - 1e-6 * E)) / 2e-6
    np.testing.assert_allclose((G @ E.reshape(3, -1, 1))[..., 0], grown, atol=1e-4)


@some
@given(seeds, st.floats(0.01, 100))
def test_a_shape_of_the_right_proportions_lacks_nothing_at_any_size(seed: int, size: float) -> None:
    X = np.random.default_rng(seed).standard_normal((1, P, 3))
    bones = bones_of(X[0])
    _, wanted, varies = bones.length_constraint(size * X)
    np.testing.assert_allclose(wanted, 0, atol=1e-9 * size)
    # A larger one as a whole surprises no more than one whose lengths all vary at random would.
    whole = size * lengths(X)[0]
    assert whole @ np.linalg.solve(varies[0], whole) < 1
    one = np.eye(len(EDGES))[0] * whole
    assert one @ np.linalg.solve(varies[0], one) > 100


@some
@given(seeds, st.sampled_from([0.05, 0.3]))
def test_the_correction_is_the_mean_given_keypoints_and_lengths(seed: int, noise: float) -> None:
    rng = np.random.default_rng(seed)
    S, W, M = rng.standard_normal((1, P, 3)), rng.standard_normal((1, P, 2)), random_cameras(1, rng)
    B = rng.standard_normal((3 * P, 3 * P))
    covariance = 0.1 * B @ B.T / P + 0.01 * np.eye(3 * P)
    bones = bones_of(rng.standard_normal((P, 3)))
    all_seen, noises = np.ones((1, P), bool), np.array([noise])
    by_keypoints = correct(S, M, W, all_seen, ErrorModel(covariance), noises)
    # Information adds up: of the errors, of the keypoints but for a translation, of the lengths.
    H = np.kron(np.eye(P), M[0].T)
    free = np.eye(2 * P) - np.tile(np.eye(2), (P, P)) / P
    G, wanted, varies = (part[0] for part in bones.length_constraint(by_keypoints))
    known = np.linalg.inv(covariance) + H.T @ free @ H / noise**2
    known += G.T @ np.linalg.solve(varies, G)
    r = (W - S @ M)[0].ravel()
    told = H.T @ free @ r / noise**2
    told += G.T @ np.linalg.solve(varies, wanted + G @ (by_keypoints - S).ravel())
    E = np.linalg.solve(known, told).reshape(P, 3)
    found = correct(S, M, W, all_seen, ErrorModel(covariance, bones), noises) - S
    np.testing.assert_allclose(found[0], E, atol=1e-2 * np.abs(E).max())


def test_lengths_tell_the_depth_that_the_network_has_flattened() -> None:
    rng, n = np.random.default_rng(0), 300
    truth = centre(rng.standard_normal((n, P, 3)))
    M = random_cameras(n, rng)
    R = rotation_from_camera(M)
    flat = truth @ R.swapaxes(1, 2) * [1, 1, 0.6] @ R  # along the line of sight
    W, seen = truth @ M, np.ones((n, P), bool)

    def wrong(spread: float | None) -> np.ndarray:
        """Return by how much the worst length of each shape is wrong."""
        found = []
        for i in range(n):
            bones = spread and bones_of(truth[i], spread)
            one, errors = slice(i, i + 1), ErrorModel(np.eye(3 * P), bones or None)
            found.append(correct(flat[one], M[one], W[one], seen[one], errors, 0.01)[0])
        return np.abs(lengths(np.array(found)) / lengths(truth) - 1).max(1)

    without, rigid = wrong(None), wrong(0.01)
    assert np.median(rigid / without) < 0.3  # one linear step does not always do so
    assert (rigid < without).mean() > 0.95
    np.testing.assert_allclose(wrong(100.0), without, atol=1e-3)  # no bones, these


def test_a_correlation_lets_bones_grow_together() -> None:
    """A long thigh is no surprise where the other one is long too."""
    X = np.random.default_rng(0).standard_normal((1, P, 3))
    bones = bones_of(X[0], 0.1)
    together = np.eye(len(EDGES))
    together[0, 1] = together[1, 0] = 0.9
    _, _, alone = bones.length_constraint(X)
    _, _, pair = bones._replace(correlation=together).length_constraint(X)
    spread = 0.1 * lengths(X)[0]
    both, opposite = np.array([1, 1, 0, 0]) * spread, np.array([1, -1, 0, 0]) * spread
    surprise = [[x @ np.linalg.solve(C[0], x) for C in (alone, pair)] for x in (both, opposite)]
    assert surprise[0][1] < 0.8 * surprise[0][0]
    assert surprise[1][1] > 5 * surprise[1][0]


def test_points_in_one_place_have_no_direction_and_do_no_harm() -> None:
    S, M = np.zeros((1, P, 3)), random_cameras(1, np.random.default_rng(0))
    bones = bones_of(np.random.default_rng(0).standard_normal((P, 3)))
    W = np.zeros((1, P, 2))
    found = correct(S, M, W, np.ones((1, P), bool), ErrorModel(np.eye(3 * P), bones))
    assert np.isfinite(found).all()


def test_rigid_edges_are_told_from_others_without_labels() -> None:
    """A network that makes small errors; an arm of the object grows, by itself, by 30 %."""
    rng = np.random.default_rng(0)
    shape, f = centre(rng.standard_normal((P, 3))), 2000
    shapes = np.tile(shape, (f, 1, 1))
    shapes[:, 5] += 0.3 * rng.uniform(-1, 1, (f, 1)) * (shape[5] - shape[4])

    def lift(W: np.ndarray) -> tuple[Any, ...]:
        """Find the frame's shape by its keypoints; every shape of a frame is seen alike."""
        errors = 0.05 * rng.standard_normal(shapes.shape)
        rows = np.linalg.pinv(shapes) @ W
        U, _, Vt = np.linalg.svd(rows, full_matrices=False)
        return shapes + errors, U @ Vt, W

    found = bone_lengths(lift, shapes @ random_cameras(f, rng), EDGES, np.eye(3 * P), rng)
    expected = relative_lengths(shapes, EDGES)
    np.testing.assert_allclose(found[:, 0], expected.mean(0), rtol=0.02)
    relative = found[:, 1] / found[:, 0]
    assert relative[3] > 2 * relative[:3].max() and relative.min() >= 0.0099
    shapes[:, 1] = shapes[:, 0]  # two keypoints in one place
    found = bone_lengths(
        lambda W: (shapes, random_cameras(f, rng), W), shapes[..., :2], EDGES, np.eye(3 * P), rng
    )
    assert (found > 0).all()
    assert not len(bone_lengths(lift, shapes @ random_cameras(f, rng), [], np.eye(3 * P), rng))


def test_bones_that_grow_together_are_told_from_errors_without_labels() -> None:
    """People of many sizes of both legs alike; the network errs on each point by itself."""
    rng = np.random.default_rng(0)
    f = 4000
    rest = np.array([[-1, 2, 0], [-1, 1, 0], [-1, 0, 0], [1, 2, 0], [1, 1, 0], [1, 0, 0.0]])
    pairs = [(0, 1), (1, 2), (3, 4), (4, 5), (0, 3)]
    shapes = np.tile(rest, (f, 1, 1))
    shin = 0.2 * np.clip(rng.standard_normal((f, 1)), -2, 2)
    shapes[:, (2, 5), 1] -= shin

    def lift(W: np.ndarray) -> tuple[Any, ...]:
        errors = 0.05 * rng.standard_normal(shapes.shape)
        rows = np.linalg.pinv(shapes) @ W
        U, _, Vt = np.linalg.svd(rows, full_matrices=False)
        return shapes + errors, U @ Vt, W

    W = shapes @ random_cameras(f, rng)
    found, correlation = varied_bones(lift, W, pairs, np.eye(18), rng)
    expected = relative_lengths(shapes, pairs)
    np.testing.assert_allclose(found[:, 0], expected.mean(0), rtol=0.03)
    np.testing.assert_allclose(found[[1, 3], 1], expected[:, [1, 3]].std(0), rtol=0.25)
    assert correlation[1, 3] > 0.8 and correlation[1, 0] < 0.4
    np.testing.assert_allclose(correlation.diagonal(), 1, atol=1e-6)
    assert np.linalg.eigvalsh(correlation)[0] > 0
