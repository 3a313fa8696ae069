# SPDX-License-Identifier: Apache-2.0
"""Smoothing before the correction: steady, by time constants of the stamps, and on SO(3)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from deep_nrsfm_ros.lifting.network_smoothing import gain, smooth_rotations, smooth_shapes
from deep_nrsfm_ros.nrsfm.geometry import centre

RNG = np.random.default_rng(0)
S = centre(RNG.standard_normal((1, 6, 3)))
SEEN = np.ones((1, 6), bool)
TIMES = (0.1, 1.0)


@pytest.mark.parametrize("rate", [8, 30, 240])
def test_time_constants_follow_the_stamps(rate: int) -> None:
    """The same step is followed by 1 - 1/e after the time constant, at any rate."""
    other = centre(S + 0.05 * RNG.standard_normal(S.shape))
    angle, Z = Rotation.identity().as_matrix()[None], S.copy()
    target = Rotation.from_rotvec([0.5, 0, 0]).as_matrix()[None]
    for _ in range(rate):
        Z = smooth_shapes(Z, other, SEEN, np.array([1 / rate]), (1.0, 1.0))
        angle = smooth_rotations(angle, target, np.array([1 / rate]), 1.0)
    turned = np.linalg.norm(Rotation.from_matrix(angle[0]).as_rotvec())
    assert turned == pytest.approx(0.5 * (1 - np.exp(-1)), rel=1e-6)
    assert np.linalg.norm(Z - other) == pytest.approx(np.linalg.norm(S - other) / np.e, rel=0.3)


def test_a_time_constant_of_0_takes_the_newest() -> None:
    assert gain(np.array([0.01]), 0.0) == 1
    new = centre(RNG.standard_normal((1, 6, 3)))
    np.testing.assert_allclose(smooth_shapes(S, new, SEEN, np.ones(1), (0, 0)), new)


def test_noise_shrinks_and_a_hidden_keypoint_stays() -> None:
    Z, hidden, rng = S.copy(), SEEN.copy(), np.random.default_rng(1)
    hidden[0, 2] = False
    raw, smoothed, place = [], [], []
    for _ in range(30):
        noisy = S + 0.1 * rng.standard_normal(S.shape)
        noisy[0, 2, 1] *= -1  # the network guesses where a hidden keypoint is
        Z = smooth_shapes(Z, centre(noisy), hidden, np.array([1 / 30]), TIMES)
        raw.append(centre(noisy)), smoothed.append(Z), place.append(Z[0, 2, 1])
    way = (S[0, 2, 1] - np.array(place)) / (2 * S[0, 2, 1])
    assert way[5] < 0.3 and 0.4 < way[-1] < 0.8
    jumps = [np.diff(each, axis=0)[5:, 0, 3:].std() for each in (raw, smoothed)]
    assert jumps[1] < 0.4 * jumps[0]


def test_a_shape_in_another_unit_is_the_same_shape() -> None:
    np.testing.assert_allclose(smooth_shapes(S, 3 * S, SEEN, np.array([0.01]), TIMES), 3 * S)


def test_rotations_go_the_short_way_at_one_speed() -> None:
    old = Rotation.random(20, random_state=0)
    step = Rotation.from_rotvec(np.linspace(0, 3.1, 20)[:, None] * np.array([0.6, 0, 0.8]))
    new = (step * old).as_matrix()
    found = smooth_rotations(old.as_matrix(), new, np.full(20, 0.05), 0.05)
    left = Rotation.from_matrix(found) * old.inv()
    np.testing.assert_allclose(
        left.magnitude(), (1 - np.exp(-1)) * step.magnitude(), rtol=1e-6, atol=1e-9
    )
