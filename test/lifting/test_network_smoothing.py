# SPDX-License-Identifier: Apache-2.0
"""Smoothing before the correction: steady, by time constants of the stamps, and on SO(3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from deep_nrsfm_ros.lifting.network_smoothing import (
    MAX_AGREEMENT,
    gain,
    smooth_rotations,
    smooth_shapes,
    weigh_turns,
)
from deep_nrsfm_ros.nrsfm.geometry import Floats, centre

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


def votes(degrees: Sequence[float], seconds: float) -> str:
    """Return what becomes of each frame: "." it is smoothed, "h" it is not believed, "n" anew.

    Args:
        degrees: angle of each new rotation; the first is remembered.
        seconds: between the frames.
    """
    rotations = Rotation.from_euler("y", degrees, degrees=True).as_matrix()[:, None]
    remembered, became = rotations[0], ""
    agreement: Floats = np.zeros(1)
    for R in rotations[1:]:
        held, begins, agreement = weigh_turns(remembered, R, agreement, np.array([seconds]))
        remembered = remembered if held[0] else R
        became += "h" if held[0] else "n" if begins[0] else "."
    return became


def test_a_few_turned_frames_are_not_believed() -> None:
    assert votes([0] * 9 + [180] * 3 + [0] * 3, 1 / 30) == "." * 8 + "hhh" + "..."


def test_an_object_that_has_turned_is_believed_after_a_while() -> None:
    became = votes([0] * 60 + [100] * 30, 1 / 30)[59:]
    assert became == "h" * 15 + "n" + "." * 14  # 15 frames are half a second
    assert became.index("n") / 30 == pytest.approx(MAX_AGREEMENT)


def test_a_short_wrong_beginning_is_outvoted() -> None:
    assert votes([180, 180, 0, 0, 0, 0], 1 / 30) == ".n..."


def test_slow_streams_are_believed_at_once() -> None:
    assert votes([0, 0, 100, 200], MAX_AGREEMENT) == ".nn"
