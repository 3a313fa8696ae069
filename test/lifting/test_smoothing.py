# SPDX-License-Identifier: Apache-2.0
"""Smoother: what rests is held still, what moves is followed, what is gone stays for a while."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import ArrayLike

from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.lifting.smoothing import FILTER_RESET_TIME, Smoother, SmoothingOptions
from deep_nrsfm_ros.nrsfm.geometry import rotation_from_vector

P = 8
SHAPE = np.random.default_rng(0).standard_normal((P, 3))
SHAPE -= SHAPE.mean(0)
ON = SmoothingOptions(enabled=True)
RATE = 60.0


def one(
    S: np.ndarray = SHAPE,
    turn: ArrayLike = (0, 0, 0),
    place: ArrayLike = (0, 0, 0),
    confidence: float = 0.8,
) -> Lifted:
    """Return an object of shape S in its own axes, turned and at its place."""
    R = rotation_from_vector(np.array(turn, float))
    parts = (S @ R.T + np.array(place), R, 1.0, np.zeros(2), 0.1, np.full(P, confidence))
    numbers = (np.asarray(part, np.float32)[None] for part in parts)
    return Lifted._make((*numbers, np.zeros((1, P), np.bool_)))


def nothing() -> Lifted:
    parts = one(confidence=0)
    unknown = (np.full_like(part, np.nan) for part in parts[:-2])
    return Lifted._make((*unknown, parts.confidence, parts.wrong))


def both(*objects: Lifted) -> Lifted:
    return Lifted._make(np.concatenate(parts) for parts in zip(*objects, strict=True))


def run(objects: Sequence[Lifted], options: SmoothingOptions = ON, rate: float = RATE) -> Lifted:
    smoother = Smoother(options)
    return both(*(smoother(lifted, ("a",), i / rate)[0] for i, lifted in enumerate(objects)))


def angles(R: np.ndarray) -> np.ndarray:
    traces = (R[1:] * R[:-1]).sum((1, 2))
    return np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)))


def moves(S: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(S, axis=0), axis=2).mean())


def test_off_it_changes_nothing() -> None:
    smoother, lifted = Smoother(SmoothingOptions()), both(one(), nothing())
    assert not SmoothingOptions().enabled
    for time in (0.0, 0.1):
        same, identities = smoother(lifted, ("a", "b"), time)
        assert same is lifted and identities == ("a", "b")


def test_what_trembles_is_held_still() -> None:
    rng = np.random.default_rng(1)
    shaken = [
        one(SHAPE + 0.03 * rng.standard_normal((P, 3)), 0.02 * rng.standard_normal(3))
        for _ in range(200)
    ]
    raw, smoothed = both(*shaken), run(shaken)
    assert angles(smoothed.rotations[50:]).mean() < 0.3 * angles(raw.rotations[50:]).mean()
    assert moves(smoothed.shapes[50:]) < 0.3 * moves(raw.shapes[50:])
    assert np.abs(smoothed.shapes[-1] - SHAPE).max() < 0.05


@pytest.mark.parametrize("rate", [30.0, 60.0, 120.0])
def test_what_moves_is_followed_as_closely_at_any_rate(rate: float) -> None:
    speed = 2.0  # radians a second
    turning = run([one(turn=(0, 0, speed * i / rate)) for i in range(int(rate))], rate=rate)
    last = turning.rotations[-1]
    behind = np.arctan2(last[1, 0], last[0, 0]) - speed * (len(turning.rotations) - 1) / rate
    assert -0.06 < (behind + np.pi) % (2 * np.pi) - np.pi < -0.01  # radians: below 30 ms


def test_more_beta_lags_less() -> None:
    path = [one(place=(0.02 * i, 0, 0)) for i in range(60)]
    behind = [
        (path[-1].shapes - run(path, dataclasses.replace(ON, beta=beta)).shapes[-1]).max()
        for beta in (0.0, 3.0, 30.0)
    ]
    assert behind[0] > 2 * behind[1] > 2 * behind[2] > 0


def test_a_turn_through_half_a_circle_takes_the_short_way_and_stays_a_rotation() -> None:
    turning = run([one(turn=(0, a, 0)) for a in np.linspace(2.5, 3.8, 80)])
    R = turning.rotations
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.tile(np.eye(3), (80, 1, 1)), atol=1e-5)
    assert angles(R).max() < 3
    radii = np.linalg.norm(turning.shapes, axis=2)
    np.testing.assert_allclose(radii, radii[:1].repeat(80, 0), rtol=1e-4)


def test_shape_and_rotation_still_belong_together() -> None:
    rng = np.random.default_rng(2)
    smoothed = run([one(turn=0.1 * rng.standard_normal(3)) for _ in range(50)])
    np.testing.assert_allclose(
        smoothed.shapes @ smoothed.rotations, SHAPE[None].repeat(50, 0), atol=1e-4
    )


def test_each_object_has_a_filter_of_its_own_wherever_it_stands_in_the_message() -> None:
    rng = np.random.default_rng(3)
    a, b = (
        [one(SHAPE + far + 0.02 * rng.standard_normal((P, 3))) for _ in range(20)]
        for far in (np.zeros((P, 3)), np.eye(P, 3))
    )
    alone = run(a)
    smoother = Smoother(ON)
    for i in range(20):
        order = ("a", "b") if i % 2 else ("b", "a")
        pair = both(a[i], b[i]) if i % 2 else both(b[i], a[i])
        together, identities = smoother(pair, order, i / RATE)
        assert identities == order
        np.testing.assert_array_equal(together.shapes[order.index("a")], alone.shapes[i])


@pytest.mark.parametrize("listed", [True, False], ids=["not lifted", "not in the message"])
def test_a_gap_is_filled_for_its_time_with_falling_confidence(listed: bool) -> None:
    smoother = Smoother(dataclasses.replace(ON, max_gap=0.4))
    empty = Lifted._make(part[:0] for part in one())
    gone, identities = (nothing(), ("a",)) if listed else (empty, ())
    smoother(one(), ("a",), 10.0)
    for wait, left in ((0.1, 0.75), (0.3, 0.25)):
        held, found = smoother(gone, identities, 10 + wait)
        assert found == ("a",)
        np.testing.assert_allclose(held.shapes[0], SHAPE, atol=1e-6)
        np.testing.assert_allclose(held.confidence, 0.8 * left, rtol=1e-5)
    after, found = smoother(gone, identities, 10.5)
    assert found == identities and np.isnan(after.residual).all()
    assert (after.confidence == 0).all()


def test_no_gap_is_filled_with_max_gap_0_or_for_a_new_object() -> None:
    smoother = Smoother(dataclasses.replace(ON, max_gap=0.0))
    smoother(one(), ("a",), 0.0)
    assert np.isnan(smoother(nothing(), ("a",), 0.01)[0].residual).all()
    assert np.isnan(Smoother(ON)(nothing(), ("b",), 0.0)[0].residual).all()


def test_an_object_that_was_away_for_long_begins_anew() -> None:
    far = one(SHAPE + np.eye(P, 3))
    for wait, anew in ((0.5 * FILTER_RESET_TIME, False), (1.5 * FILTER_RESET_TIME, True)):
        smoother = Smoother(dataclasses.replace(ON, min_cutoff=0.1, beta=0.0))
        smoother(one(), ("a",), 0.0)
        back, _ = smoother(far, ("a",), wait)
        assert np.array_equal(back.shapes, far.shapes) == anew


def test_what_comes_late_or_twice_passes_and_leaves_no_trace() -> None:
    options = dataclasses.replace(ON, min_cutoff=0.1, beta=0.0)
    untouched, smoother = Smoother(options), Smoother(options)
    odd = one(5 * SHAPE)
    for other in (untouched, smoother):
        other(one(), ("a",), 1.0)
    for time in (1.0, 0.5):
        np.testing.assert_array_equal(smoother(odd, ("a",), time)[0].shapes, odd.shapes)
    next_one = one(2 * SHAPE)
    expected, found = (f(next_one, ("a",), 1.1)[0].shapes for f in (untouched, smoother))
    np.testing.assert_array_equal(expected, found)


def test_a_clock_that_goes_far_back_begins_anew() -> None:
    smoother = Smoother(dataclasses.replace(ON, min_cutoff=0.1, beta=0.0))
    smoother(one(), ("a",), 100.0)
    smoother(one(2 * SHAPE), ("a",), 1.0)
    again, _ = smoother(one(3 * SHAPE), ("a",), 1.1)
    assert 2 < (again.shapes[0] / SHAPE).mean() < 2.5


@pytest.mark.parametrize("rate", [1, 5, 30, 240])
def test_gaps_and_restart_follow_the_rate_of_the_stream(rate: int) -> None:
    period, empty = 1 / rate, Lifted._make(part[:0] for part in one())
    smoother = Smoother(ON)
    smoother(one(), ("a",), 0.0, period)
    assert smoother(empty, (), 2 * period, period)[1] == ("a",)
    gone = max(0.3, 3 * period) + period
    assert smoother(empty, (), gone, period)[1] == ()
    weak = Smoother(dataclasses.replace(ON, min_cutoff=0.001, beta=0.0))
    weak(one(), ("a",), 0.0, period)
    moved = one()._replace(shapes=one().shapes * np.float32(1.5))
    kept = weak(moved, ("a",), 2.5 * period, period)[0]
    assert not np.allclose(kept.shapes, moved.shapes, atol=1e-3)
