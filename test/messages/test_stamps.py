# SPDX-License-Identifier: Apache-2.0
"""Each message of a topic has a time on the topic's clock, whatever its stamp."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deep_nrsfm_ros.messages.stamps import (
    Moment,
    RateLimit,
    TopicClock,
    check_stamps,
    one_clock,
)

SECOND = 1_000_000_000
WALL = 1_700_000_000 * SECOND


def at(*seconds: float) -> list[int]:
    """Return times in ns."""
    return [round(second * SECOND) for second in seconds]


def test_stamps_of_one_clock_stay() -> None:
    stamps, warnings = one_clock(at(5, 5.1, 5.2), [WALL, WALL + 1, WALL + 2])
    assert stamps.tolist() == at(5, 5.1, 5.2) and not warnings


def test_late_messages_keep_their_stamps() -> None:
    stamps, warnings = one_clock(at(5, 5.2, 5.1, 5.3), [WALL + i for i in range(4)])
    assert stamps.tolist() == at(5, 5.2, 5.1, 5.3) and not warnings


def test_messages_without_any_stamp_have_the_time_of_recording() -> None:
    stamps, warnings = one_clock([0, 0], [WALL, WALL + 7])
    assert stamps.tolist() == [WALL, WALL + 7] and not warnings


@pytest.mark.parametrize("first", [0, WALL])
def test_first_stamps_before_the_simulated_clock_come_first(first: int) -> None:
    received = [WALL + i * SECOND // 10 for i in range(8)]
    stamps, warnings = one_clock([first] * 3 + at(12.3, 12.4, 12.5, 12.6, 12.7), received)
    assert stamps.tolist() == at(12.0, 12.1, 12.2, 12.3, 12.4, 12.5, 12.6, 12.7)
    assert len(warnings) == 1 and "3 of 8 stamps" in warnings[0]


def test_a_stamp_of_zero_amid_others() -> None:
    received = [WALL + i * SECOND // 10 for i in range(4)]
    stamps, warnings = one_clock(at(50, 50.1, 0, 50.3), received)
    assert stamps.tolist() == at(50, 50.1, 50.2, 50.3) and "1 of 4" in warnings[0]


def test_loops_follow_one_another() -> None:
    loop = np.arange(0, 5, 0.1)
    received = [WALL + i * SECOND // 10 for i in range(3 * len(loop))]
    stamps, warnings = one_clock(at(*np.tile(20 + loop, 3)), received)
    assert np.allclose(np.diff(stamps), 0.1 * SECOND)
    assert len(warnings) == 1 and "go back 2 times" in warnings[0]


def test_no_message() -> None:
    assert one_clock([], [])[0].shape == (0,)


@given(
    st.lists(
        st.tuples(st.sampled_from([0, 3 * SECOND, 90 * SECOND, WALL]), st.integers(0, SECOND)),
        min_size=1,
        max_size=12,
    )
)
def test_whatever_the_stamps_none_goes_back_by_more_than_a_second(
    messages: list[tuple[int, int]],
) -> None:
    received = np.cumsum([1 + step for _, step in messages]) + WALL
    stamps, _ = one_clock([stamp + (stamp and step) for stamp, step in messages], received)
    assert (stamps >= np.maximum.accumulate(stamps) - SECOND).all()


@pytest.mark.parametrize("rate", [1, 5, 30, 240])
def test_the_period_is_that_of_the_stream(rate: int) -> None:
    clock = TopicClock()
    moments = [clock(SECOND + i * SECOND // rate, i * SECOND // rate) for i in range(1, 40)]
    assert moments[0].period == 0
    assert all(moment.period == pytest.approx(1 / rate, rel=1e-6) for moment in moments[1:])
    assert not any(moment.restarted for moment in moments) and not clock.warning


def test_a_pause_does_not_change_the_period() -> None:
    clock = TopicClock()
    for i in range(20):
        clock(SECOND + i * SECOND // 30, i)
    assert clock(10 * SECOND, 21).period == pytest.approx(1 / 30, rel=1e-6)


def test_a_looped_bag_begins_anew_once_a_loop() -> None:
    clock, stamps = TopicClock(), at(*np.tile(20 + np.arange(0, 5, 0.1), 3))
    moments = [clock(stamp, i * SECOND // 10) for i, stamp in enumerate(stamps)]
    assert [i for i, moment in enumerate(moments) if moment.restarted] == [50, 100]
    assert not clock.warning


def test_late_messages_do_not_begin_anew() -> None:
    clock = TopicClock()
    stamps = at(20, 20.1, 20.2, 20.15, 20.3)
    assert not any(clock(stamp, i).restarted for i, stamp in enumerate(stamps))


@pytest.mark.parametrize("first", [0, WALL])
def test_a_live_topic_that_begins_before_the_clock_does_not_jump(first: int) -> None:
    clock = TopicClock()
    early = [first and first + i * SECOND // 10 for i in range(5)]
    stamps = early + at(*np.arange(12.5, 20, 0.1))
    moments = [clock(stamp, 77 * SECOND + i * SECOND // 10) for i, stamp in enumerate(stamps)]
    steps = np.diff([moment.seconds for moment in moments])
    assert np.allclose(steps, 0.1, atol=1e-5)
    assert not any(moment.restarted for moment in moments)
    assert bool(clock.warning) == bool(first)


def test_a_stamp_of_zero_in_a_live_topic_is_named_once() -> None:
    clock = TopicClock()
    moments = [clock(stamp, i * SECOND) for i, stamp in enumerate(at(1, 2, 0, 4, 0))]
    assert [moment.seconds for moment in moments] == pytest.approx([1, 2, 3, 4, 5])
    assert "a stamp is 0" in clock.warning


def test_a_topic_that_never_has_stamps_is_no_problem() -> None:
    clock = TopicClock()
    assert [clock(0, i * SECOND).seconds for i in range(3)] == [0, 1, 2]
    assert not clock.warning


@pytest.mark.parametrize(("hertz", "rate", "expected"), [(30, 10, 101), (25, 10, 101), (5, 10, 51)])
def test_a_rate_limit_keeps_the_rate_on_average(hertz: int, rate: int, expected: int) -> None:
    """Stamps jitter by a millisecond, as a camera's do."""
    noise = np.random.default_rng(0).uniform(-0.001, 0.001, 10 * hertz + 1)
    limit = RateLimit(rate)
    due = [limit.is_due(Moment(i / hertz + x, 1 / hertz)) for i, x in enumerate(noise)]
    assert due[0] and abs(sum(due) - expected) <= 1


def test_a_rate_limit_of_zero_chooses_all_messages() -> None:
    limit = RateLimit(0)
    assert all(limit.is_due(Moment(second)) for second in (1.0, 1.0, 1.001, 0.5, 7.0))


@pytest.mark.parametrize("second", [100.0, 0.0])
def test_after_a_jump_of_time_a_message_is_due_and_the_next_is_not(second: float) -> None:
    limit = RateLimit(10)
    assert [limit.is_due(Moment(t)) for t in (50.0, 50.04)] == [True, False]
    assert [limit.is_due(Moment(second + t)) for t in (0.0, 0.04, 0.1)] == [True, False, True]


def times(*seconds: float) -> np.ndarray:
    """Return times as an array in ns."""
    return np.array(at(*seconds), np.int64)


@pytest.mark.parametrize(
    ("stamps", "said"),
    [
        (times(*np.arange(1800, 1801, 1 / 30)), ""),
        (times(), ""),
        (times(*[0] * 16), "the last 16 messages on /k all have the stamp 0.000 s: let the"),
        (times(*[100] * 4), "the last 4 messages on /k all have the stamp 100.000 s: let the"),
        (
            times(100, 1.7e9, 100.1, 1.7e9 + 0.1, 100.2),
            "the stamps on /k are of two clocks, 100.000 s and 1700000000.100 s: ",
        ),
        (times(0.1, 0.2, 1.7e9, 1.7e9 + 0.1), ""),  # the clock has begun
        (np.arange(16) * 33, "the stamps on /k are 3.3e-08 s apart: header.stamp.sec must be"),
        (times(*range(0, 99000, 33000)), "the stamps on /k are 3.3e+04 s apart: header.stamp"),
        (times(*np.tile(np.arange(8), 2)), ""),  # a bag in a loop
        (
            times(*np.repeat(np.arange(8), 2)),
            "8 of 15 stamps on /k are not above the one before: do several detectors",
        ),
    ],
)
def test_the_stamps_of_live_messages_are_named_with_the_mend(stamps: np.ndarray, said: str) -> None:
    found = [str(finding) for finding in check_stamps(stamps.astype(np.int64), "/k")]
    assert [text[: len(said)] for text in found] == [said] * bool(said)
