# SPDX-License-Identifier: Apache-2.0
"""Objects keep their identities while they are seen."""

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from deep_nrsfm_ros import kernel
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.lifting.observation import Identities, Observation
from deep_nrsfm_ros.lifting.track_matching import (
    keypoint_tolerances,
    match,
    match_by_numpy,
    new_tracks,
    update,
    update_by_numpy,
)
from deep_nrsfm_ros.lifting.tracking import MAX_TRACK_AGE, Tracker

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
    assert tracker(seen((100, 100)), MAX_TRACK_AGE) == (a,)
    assert tracker(seen((100, 100)), 3 * MAX_TRACK_AGE)[0] not in (a, b)


def test_another_number_of_keypoints_is_another_object() -> None:
    tracker = Tracker()
    (a,) = tracker(seen((100, 100)), 0.0)
    whole = seen((100, 100))
    fewer = Observation(whole.points[:, :5], whole.confidence[:, :5])
    (b,) = tracker(fewer, 0.1)
    assert a != b == tracker(fewer, 0.2)[0]


def test_what_is_hidden_is_where_the_rest_has_moved_it() -> None:
    tracker = Tracker()
    (a,) = tracker(seen((100, 100)), 0.0)
    half = hide(seen((110, 100)), slice(4, None))
    assert tracker(half, 0.1) == (a,)
    assert tracker(hide(seen((120, 100)), slice(0, 4)), 0.2) == (a,)


def test_an_object_without_a_common_keypoint_is_known_by_its_place() -> None:
    tracker = Tracker()
    (a,) = tracker(hide(seen((100, 100)), slice(4, None)), 0.0)
    far, near = tracker(hide(seen((900, 100), (100, 100)), slice(0, 4)), 0.1)
    assert near == a != far


def hide(observation: Observation, keypoints: slice) -> Observation:
    """Return the observation without some of the keypoints."""
    observation.points[:, keypoints] = observation.confidence[:, keypoints] = 0
    return observation


@pytest.mark.parametrize("rate", [5, 30, 240])
def test_people_who_cross_keep_their_identities(rate: int) -> None:
    tracker = Tracker()
    rng = np.random.default_rng(rate)
    names = []
    for frame in range(3 * rate):
        x = 200 * frame / rate  # pixels: 4 sizes a second
        both = seen((100 + x, 100), (700 - x, 130))
        if abs(600 - 2 * x) < 60:  # the second person is hidden for 0.15 s
            names.append((tracker(_rows(both, [0]), frame / rate)[0], None))
            continue
        order = rng.permutation(2)
        identities = tracker(_rows(both, order), frame / rate)
        names.append(tuple(identities[i] for i in np.argsort(order)))
    assert {a for a, _ in names} == {names[0][0]}
    assert {b for _, b in names} - {None} == {names[0][1]}


def _rows(observation: Observation, rows: Any) -> Observation:
    """Return some of the objects."""
    return Observation(observation.points[rows], observation.confidence[rows])


def test_people_who_exchange_wrong_keypoints_keep_their_identities() -> None:
    tracker = Tracker()
    a, b = tracker(seen((100, 100), (130, 100)), 0.0)
    mixed = seen((102, 100), (128, 100))
    mixed.points[:, :3] = mixed.points[::-1, :3]
    assert tracker(mixed, 0.1) == (a, b)


def test_the_assignment_is_the_best_of_all_and_not_the_nearest_pair_first() -> None:
    tracker = Tracker()
    a, b = tracker(seen((100, 100), (150, 100)), 0.0)
    # The nearest pair is the first detection and b, which leaves a to the second one, far away.
    assert tracker(seen((127, 100), (173, 100)), 0.1) == (a, b)


def test_the_order_of_objects_does_not_matter() -> None:
    places = [(100.0, 100.0), (160.0, 100.0), (220.0, 100.0), (900.0, 0.0)]
    forward, backward = Tracker(), Tracker()
    for frame in range(5):
        moved = [(x + 20 * frame, y) for x, y in places]
        names = forward(seen(*moved), frame / 10)
        assert names == backward(seen(*moved[::-1]), frame / 10)[::-1]


def test_of_two_objects_with_one_identity_the_more_visible_one_keeps_it() -> None:
    both = seen((0, 0), (300, 0), identities=("7", "7"))
    both.confidence[0, :3] = both.points[0, :3] = 0
    assert Tracker()(both, 0.0) == ("object1", "7")


def test_a_stream_of_one_image_a_second_keeps_identities() -> None:
    tracker = Tracker()
    a, b = tracker(seen((100, 100), (600, 100)), 0.0)
    for second in range(1, 5):
        assert tracker(seen((100 + 40 * second, 100), (600, 100)), second, 1.0) == (a, b)
    assert tracker(seen((600, 100)), 6.0, 1.0) == (b,)
    assert tracker(seen((600, 100)), 8.9, 1.0) == (b,)
    assert tracker(seen((600, 100)), 12.1, 1.0) != (b,)


def test_stamps_that_begin_anew_begin_new_identities() -> None:
    tracker = Tracker()
    (a,) = tracker(seen((100, 100)), 10.0)
    assert tracker(seen((100, 100)), 9.99) == (a,)
    assert tracker(seen((100, 100)), 2.0) != (a,)


def test_the_number_of_tracks_is_bounded() -> None:
    tracker = Tracker()
    for frame in range(300):
        tracker(seen(*[(1e4 * frame + 900 * i, 0) for i in range(5)]), frame / 1e4)
    assert tracker.track_count <= 5 + 256


def test_keypoints_of_known_names_have_the_tolerance_of_coco() -> None:
    tolerances = keypoint_tolerances(HUMAN17)
    assert tolerances.shape == (17,) and (tolerances >= 0.1).all()
    hip, wrist = HUMAN17.index("left_hip"), HUMAN17.index("right_wrist")
    assert tolerances[hip] > tolerances[wrist]
    assert set(keypoint_tolerances(KeypointLayout.numbered(5)).tolist()) == {np.float32(0.2)}


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


def test_a_lone_object_is_followed_as_among_others() -> None:
    rng = np.random.default_rng(0)
    alone, among = Tracker(), Tracker()
    x = 0.0
    for frame in range(200):
        x += float(rng.choice([3.0, 3.0, 3.0, 55.0, 120.0]))
        body = seen((x, 100))
        if rng.random() < 0.3:
            body = hide(body, slice(0, 3))
        other = Observation(
            np.concatenate([body.points, seen((-1e5, 0)).points]),
            np.concatenate([body.confidence, np.ones((1, 8), np.float32)]),
        )
        (first,) = alone(body, frame / 30)
        second, _ = among(other, frame / 30)
        number = int(second.removeprefix("object"))
        assert int(first.removeprefix("object")) == max(1, number - 1)


@pytest.mark.skipif(not kernel.AVAILABLE, reason="no C compiler")
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.sampled_from([1, 2, 40]),
    m=st.sampled_from([1, 2, 9]),
    missing=st.sampled_from([0.0, 0.3, 0.8]),
)
def test_the_kernel_matches_as_numpy_does(seed: int, n: int, m: int, missing: float) -> None:
    rng = np.random.default_rng(seed)

    def bodies(count: int) -> tuple[np.ndarray, np.ndarray]:
        points = 20 * BODY[None] + 50 * rng.standard_normal((count, 1, 2))
        points += 10 * rng.standard_normal((count, 8, 2))
        confidence = (rng.random((count, 8)) >= missing).astype(np.float32)
        confidence[:, 0] = 1
        return points.astype(np.float32), confidence

    tracks = new_tracks(*bodies(m), 0.0)
    tracks.velocity[:] = rng.standard_normal(m) + 1j * rng.standard_normal(m)
    tracks.age[tracks.age == 0] = rng.choice([0, 0.3], (tracks.age == 0).sum())
    passed = rng.uniform(0, 1, m).astype(np.float32)
    points, confidence = bodies(n)
    tolerances = rng.uniform(0.1, 0.3, 8).astype(np.float32)
    found = match(tracks, passed, points, confidence, tolerances)
    wanted = match_by_numpy(tracks, passed, points, confidence, tolerances)
    assume(wanted.score.max() > 0.01)
    np.testing.assert_allclose(found.score, wanted.score, atol=1e-5)
    np.testing.assert_allclose(found.shift, wanted.shift, atol=1e-2)  # pixels, of some 1000
    best = np.where(found.best >= 0, found.score[np.arange(n), found.best], 0)
    np.testing.assert_allclose(best, wanted.score.max(1), atol=1e-5)
    assigned = np.full(n, -1, np.int32)
    assigned[: min(n, m)] = rng.permutation(m)[:n]
    updated = update(tracks, passed, points, confidence, assigned, wanted.shift)
    expected = update_by_numpy(tracks, passed, points, confidence, assigned, wanted.shift)
    for ours, numpy in zip(updated, expected, strict=True):
        np.testing.assert_allclose(ours, numpy, rtol=1e-5, atol=1e-3)
