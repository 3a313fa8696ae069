# SPDX-License-Identifier: Apache-2.0
"""Errors of known perturbations, what must not change them, and which way round a shape is."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras, rotation_from_camera
from deep_nrsfm_ros.nrsfm.metrics import (
    camera_errors,
    procrustes_distances,
    shape_errors,
)

some = settings(max_examples=25, deadline=None)
seeds = st.integers(0, 2**32 - 1)
MIRROR = np.array([1.0, 1.0, -1.0])


def rotations(n: int, rng: np.random.Generator) -> np.ndarray:
    return rotation_from_camera(random_cameras(n, rng).astype(float))


def frames(seed: int, f: int = 20) -> tuple[np.ndarray, np.ndarray, np.random.Generator]:
    """Return centred truth (f, 10, 3) and a reconstruction that is some 20 % off."""
    rng = np.random.default_rng(seed)
    truth = centre(rng.standard_normal((f, 10, 3)))
    return truth, truth + 0.2 * rng.standard_normal(truth.shape), rng


@some
@given(seeds, st.floats(0.01, 100))
def test_place_and_attitude_do_not_matter(seed: int, factor: float) -> None:
    truth, S, rng = frames(seed)
    errors = shape_errors(S, truth)
    moved = S @ rotations(len(S), rng) + rng.standard_normal((len(S), 1, 3))
    np.testing.assert_allclose(shape_errors(moved, truth), errors, atol=1e-6)
    truth_moved = truth @ rotations(len(S), rng) + 5
    np.testing.assert_allclose(shape_errors(S, truth_moved), errors, atol=1e-6)
    mirrored = shape_errors(S * MIRROR, truth)  # the whole set: one global reflection
    np.testing.assert_allclose(mirrored[:5], errors[:5], atol=1e-6)
    assert mirrored.reflected == 1 - errors.reflected
    scaled = shape_errors(factor * S, truth)
    np.testing.assert_allclose(scaled[:4], errors[:4], atol=1e-6)
    distances = procrustes_distances(S, truth)
    np.testing.assert_allclose(procrustes_distances(factor * moved, truth), distances, atol=1e-6)


def test_perfect_is_zero() -> None:
    truth, _, _ = frames(0)
    np.testing.assert_allclose(shape_errors(truth, truth), 0, atol=1e-9)
    np.testing.assert_allclose(procrustes_distances(truth, truth), 0, atol=1e-9)


OCTAHEDRON = np.concatenate([np.diag([1.0, 2, 3]), -np.diag([1.0, 2, 3])])[None]


def test_errors_of_a_shape_pulled_apart_by_hand() -> None:
    # Symmetric, so that neither centre nor best rotation moves: only z grows, from 3 to 4.
    pulled = OCTAHEDRON * [1, 1, 4 / 3]
    after = (2 * (1 + 4 + 16)) ** 0.5
    before = (2 * (1 + 4 + 9)) ** 0.5
    unscaled = 2**0.5 / before
    errors = shape_errors(pulled, OCTAHEDRON)
    assert errors.unscaled == pytest.approx(unscaled)
    s = before / after
    moves = np.array([s - 1, 2 * s - 2, 4 * s - 3])
    assert errors.shape == errors.proper == pytest.approx((2 * moves @ moves) ** 0.5 / before)
    assert errors.point == pytest.approx(np.abs(moves).mean())
    best = (1 + 4 + 12) / (1 + 4 + 16)  # least squares instead of equal norms
    expected = np.abs(best * np.array([1, 2, 4]) - [1, 2, 3])
    np.testing.assert_allclose(procrustes_distances(pulled, OCTAHEDRON), [[*expected, *expected]])


def test_only_unscaled_sees_the_size() -> None:
    truth, _, _ = frames(0)
    errors = shape_errors(1.25 * truth, truth)
    np.testing.assert_allclose(errors[:4], 0, atol=1e-9)
    assert errors.unscaled == pytest.approx(0.25)


@pytest.mark.parametrize("count", [0, 3, 10, 17, 20])
def test_mirrored_frames_are_counted(count: int) -> None:
    truth, _, rng = frames(1)
    S = truth.copy()
    S[rng.permutation(20)[:count]] *= MIRROR
    errors = shape_errors(S @ rotations(20, rng), truth)
    share = min(count, 20 - count) / 20
    assert errors.mirrored == pytest.approx(share)
    assert errors.shape == pytest.approx(0, abs=1e-6)  # the published metric hides them
    assert (errors.proper > 0.1 * share) if share else (errors.proper < 1e-6)


def test_procrustes_never_reflects() -> None:
    truth, _, _ = frames(2)
    assert procrustes_distances(truth * MIRROR, truth).mean() > 0.1


def person(frames: int = 20) -> np.ndarray:
    """Return (frames, 12, 3) random shapes in mm, away from the origin."""
    return np.random.default_rng(0).normal([0, 0, 3000], 300, (frames, 12, 3))


def test_errors_of_a_perfect_shape_at_any_scale_and_place() -> None:
    truth = person()
    truth[3, 5] = np.nan  # a frame that is not wholly known
    S = np.nan_to_num(truth) * 0.001 + [1, 2, 3]
    np.testing.assert_allclose(camera_errors(S, truth), 0, atol=1e-4)


def test_a_turned_shape_is_wrong_in_the_camera_only() -> None:
    turn = Rotation.from_rotvec(np.radians([0, 30, 0])).as_matrix()
    error = camera_errors(person() @ turn, person())
    assert error.aligned < 1e-6 and error.in_camera > 100
    assert error.rotation == pytest.approx(30) and error.mirrored == 0


def test_a_mirrored_shape_is_found_out() -> None:
    half = person()
    half[:10, :, 2] *= -1
    error = camera_errors(half, person())
    assert error.mirrored == 0.5 and error.aligned > 50


def test_frames_with_a_nan_are_left_out_alike() -> None:
    truth, S, _ = frames(3)
    kept = np.delete(np.arange(len(S)), [4, 7])
    S[4] = np.nan  # as a lifter returns what it has not lifted
    truth[7, 2, 0] = np.nan
    for errors in (shape_errors, camera_errors):
        assert errors(S, truth) == errors(S[kept], truth[kept])
    distances = procrustes_distances(S, truth)
    assert np.isnan(distances[[4, 7]]).all()
    np.testing.assert_array_equal(distances[kept], procrustes_distances(S[kept], truth[kept]))


@pytest.mark.parametrize("errors", [shape_errors, camera_errors, procrustes_distances])
def test_arrays_that_do_not_fit_are_refused(errors: Callable[..., object]) -> None:
    truth, S, _ = frames(3)
    with pytest.raises(ValueError, match=r"shapes are \(20, 5, 3\) and the truth is \(20, 10, 3\)"):
        errors(S[:, :5], truth)
    with pytest.raises(ValueError, match="the same points in the same order"):
        errors(S[..., :2], truth[..., :2])
    with pytest.raises(ValueError, match="in each of the 20 frames a point"):
        errors(S, truth * np.nan)
