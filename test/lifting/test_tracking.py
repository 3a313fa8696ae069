"""Objects keep their identities while they are seen."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from deep_nrsfm_ros.lifting.observation import Identities, Observation
from deep_nrsfm_ros.lifting.tracking import MAX_AGE, Tracker

BODY = np.random.default_rng(0).uniform(-50, 50, (8, 2)).astype(np.float32)


def seen(*places: tuple[float, float], identities: Identities = ()) -> Observation:
    """Return bodies at some places in the image."""
    points = np.array([BODY + place for place in places], np.float32).reshape(-1, 8, 2)
    return Observation(points, np.ones(points.shape[:2], np.float32), identities)


def test_objects_that_move_and_change_places_in_the_message_keep_their_identities() -> None:
    tracker = Tracker()
    a, b = tracker(seen((100, 100), (500, 100)), 0.0)
    assert a != b
    assert tracker(seen((470, 110), (130, 90)), 0.1) == (b, a)
    assert tracker(seen((160, 80)), 0.2) == (a,)
    assert tracker(seen((440, 120), (190, 70)), 0.3) == (b, a)


def test_the_nearest_comes_first() -> None:
    tracker = Tracker()
    (a,) = tracker(seen((100, 100)), 0.0)
    b, again = tracker(seen((140, 100), (110, 100)), 0.1)
    assert again == a != b


def test_a_jump_is_another_object_and_so_is_one_that_was_long_away() -> None:
    tracker = Tracker()
    (a,) = tracker(seen((100, 100)), 0.0)
    (b,) = tracker(seen((400, 100)), 0.1)
    assert a != b
    assert tracker(seen((100, 100)), MAX_AGE) == (a,)
    assert tracker(seen((100, 100)), 3 * MAX_AGE)[0] not in (a, b)


def test_another_number_of_keypoints_is_another_object() -> None:
    tracker = Tracker()
    (a,) = tracker(seen((100, 100)), 0.0)
    whole = seen((100, 100))
    fewer = Observation(whole.points[:, :5], whole.confidence[:, :5])
    (b,) = tracker(fewer, 0.1)
    assert a != b == tracker(fewer, 0.2)[0]


def test_only_keypoints_that_both_show_are_compared() -> None:
    tracker = Tracker()
    (a,) = tracker(seen((100, 100)), 0.0)
    half = seen((100, 100))
    half.points[0, 4:] = half.confidence[0, 4:] = 0
    assert tracker(half, 0.1) == (a,)
    other = seen((100, 100))
    other.points[0, :4] = other.confidence[0, :4] = 0
    assert tracker(other, 0.2) != (a,)


def test_the_detectors_identities_stay_and_a_second_of_the_same_is_another() -> None:
    tracker = Tracker()
    x, y, z = tracker(seen((0, 0), (300, 0), (600, 0), identities=("7", None, "7")), 0.0)
    assert x == "7" and len({x, y, z}) == 3
    assert tracker(seen((300, 0), (0, 0), identities=(None, "7")), 0.1) == (y, "7")


def test_the_detectors_identities_are_not_given_again() -> None:
    assert Tracker()(seen((0, 0), (300, 0), identities=("object1", None)), 0.0) == (
        "object1",
        "object2",
    )


def test_an_object_without_keypoints_has_no_name() -> None:
    nothing = seen((0, 0), (300, 0))
    nothing.points[1] = nothing.confidence[1] = 0
    assert Tracker()(nothing, 0.0)[1] == ""


def test_identities_of_one_topic_among_several() -> None:
    tracker = Tracker("body_ab")
    assert tracker(seen((0, 0)), 0.0) == ("body_ab",)
    assert tracker(seen((0, 0), identities=("3",)), 0.1) == ("body_ab/3",)
    assert tracker(seen((0, 0), (300, 0)), 0.2) == ("body_ab/object1", "body_ab/object2")


@given(
    st.lists(
        st.lists(st.tuples(st.integers(0, 900), st.sampled_from([None, "", "1", "2"])), max_size=5),
        max_size=6,
    )
)
def test_identities_differ_whatever_comes(frames: list[list[tuple[int, str | None]]]) -> None:
    tracker = Tracker()
    for time, frame in enumerate(frames):
        places = [(float(x), 0.0) for x, _ in frame]
        identities = tracker(
            seen(*places, identities=tuple(identity for _, identity in frame)), time / 10
        )
        assert len(set(identities)) == len(frame) and all(identities)
