# SPDX-License-Identifier: Apache-2.0
"""What never came is counted while it is clear whose numbers they are."""

from __future__ import annotations

from deep_nrsfm_ros.messages.dropped_messages import DroppedMessages

A, B = b"a", b"b"


def gaps_after(*numbers: int | None) -> DroppedMessages:
    gaps = DroppedMessages()
    for number in numbers:
        gaps.received(number)
    return gaps


def test_gaps_are_counted_once() -> None:
    gaps = gaps_after(1, 2, 5, 6, 10)
    assert gaps.take_count([A]) == 2 + 3
    assert gaps.take_count([A]) == 0
    gaps.received(12)
    assert gaps.take_count([A]) == 1


def test_what_came_before_the_first_message_is_not_missed() -> None:
    assert gaps_after(1000, 1001).take_count([A]) == 0


def test_the_last_gap_of_a_publisher_that_has_gone_counts() -> None:
    gaps = gaps_after(1, 2)
    assert gaps.take_count([A]) == 0
    gaps.received(4)
    assert gaps.take_count([]) == 1


def test_numbers_of_two_publishers_tell_nothing() -> None:
    assert gaps_after(1000, 5, 1001, 6).take_count([A, B]) == 0


def test_a_publisher_in_the_place_of_another_is_not_taken_for_it() -> None:
    gaps = gaps_after(1, 2)
    gaps.take_count([A])
    gaps.received(500)
    assert gaps.take_count([B]) == 0
    gaps.received(502)
    assert gaps.take_count([B]) == 1


def test_a_publisher_that_comes_later_counts_anew() -> None:
    gaps = gaps_after(1, 2)
    gaps.take_count([A])
    gaps.take_count([])
    gaps.received(7)
    assert gaps.take_count([B]) == 0


def test_a_publisher_that_starts_again_is_behind_not_ahead() -> None:
    assert gaps_after(7, 8, 1, 2).take_count([A]) == 0


def test_a_middleware_without_numbers_tells_nothing() -> None:
    assert gaps_after(None, None, 5, None, 9).take_count([A]) == 0
