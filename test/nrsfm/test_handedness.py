# SPDX-License-Identifier: Apache-2.0
"""Which way round shapes are, by the votes of one or more tetrahedra."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras, rotation_from_camera
from deep_nrsfm_ros.nrsfm.handedness import front_shares, is_mirrored, object_frame, votes

some = settings(max_examples=25, deadline=None)
seeds = st.integers(0, 2**32 - 1)
MIRROR = np.array([1.0, 1.0, -1.0])


def rotations(n: int, rng: np.random.Generator) -> np.ndarray:
    return rotation_from_camera(random_cameras(n, rng).astype(float))


FOUR = ("left_hip", "right_hip", "neck", "nose")
NAMES = ("left_hip", "nose", "right_hip", "neck", "tail")
PERSON = KeypointLayout("person", NAMES, handedness=(FOUR,))
# x to the front, y to the left, z up.
STANDING = np.array([[0, 0.2, 0], [0.3, 0, 0.8], [0, -0.2, 0], [0, 0, 0.6], [-0.2, 0, 0.1]])


def people(seed: int, f: int = 30) -> np.ndarray:
    return STANDING + np.random.default_rng(seed).normal(0, 0.02, (f, *STANDING.shape))


def test_a_vote_is_how_far_the_front_is_before_the_plane_of_the_others() -> None:
    # The nose is 0.3 before the hips and the neck, which lie in x = 0.
    radius = (np.square(centre(STANDING)).sum(1).mean()) ** 0.5
    np.testing.assert_allclose(votes(STANDING[None], PERSON), [[0.3 / radius]])
    np.testing.assert_allclose(votes(7 * STANDING[None] + 5, PERSON), [[0.3 / radius]])
    turned = people(0) @ rotations(30, np.random.default_rng(0))
    assert (votes(turned, PERSON) > 0).all()
    for axis in np.eye(3):
        mirror = np.eye(3) - 2 * np.outer(axis, axis)
        np.testing.assert_allclose(votes(turned @ mirror, PERSON), -votes(turned, PERSON))


@some
@given(seeds, st.booleans())
def test_object_frame_rights_an_ensemble_and_names_its_axes(seed: int, inside_out: bool) -> None:
    rng = np.random.default_rng(seed)
    network_axes = rotations(1, rng)[0] * (-1 if inside_out else 1)
    S = people(seed) @ network_axes
    assert ((votes(S, PERSON) < 0) == inside_out).all()
    assert is_mirrored(S, PERSON) == inside_out
    A = object_frame(S, PERSON)
    np.testing.assert_allclose(A @ A.T, np.eye(3), atol=1e-5)
    assert np.linalg.det(A) == pytest.approx(-1 if inside_out else 1, abs=1e-5)
    right = S @ A
    assert (votes(right, PERSON) > 0).all()
    np.testing.assert_allclose(right.mean(0), STANDING, atol=0.06)


def test_the_majority_decides_which_way_round() -> None:
    S = people(3)
    S[:10] *= MIRROR
    assert np.linalg.det(object_frame(S, PERSON)) > 0
    S[10:25] *= MIRROR
    assert np.linalg.det(object_frame(S, PERSON)) < 0


def test_layouts_without_handedness_keep_their_axes_and_have_no_volume() -> None:
    nameless = KeypointLayout.numbered(5)
    np.testing.assert_array_equal(object_frame(people(0), nameless), np.eye(3))
    with pytest.raises(ValueError, match="points5.*handedness"):
        votes(people(0), nameless)


def test_every_order_of_the_four_has_the_sign_of_its_permutation() -> None:
    for order in itertools.permutations(range(4)):
        a, b, c, d = (FOUR[i] for i in order)
        layout = KeypointLayout("person", NAMES, handedness=((a, b, c, d),))
        sign = np.linalg.det(np.eye(4)[list(order)])
        assert np.sign(votes(STANDING[None], layout)[0]) == sign


# x to the front, y to the left, z up; one leg a little before the other.
WALKING = {
    "neck": (0.0, 0.0, 1.4),
    "mid_hip": (0.0, 0.0, 0.9),
    "nose": (0.12, 0.0, 1.55),
    "left_shoulder": (0.0, 0.2, 1.4),
    "left_elbow": (0.0, 0.25, 1.1),
    "left_wrist": (0.1, 0.25, 0.9),
    "left_hip": (0.0, 0.1, 0.9),
    "left_knee": (0.15, 0.1, 0.5),
    "left_ankle": (0.1, 0.1, 0.1),
    "left_big_toe": (0.25, 0.12, 0.02),
    "right_shoulder": (0.0, -0.2, 1.4),
    "right_elbow": (0.0, -0.25, 1.1),
    "right_wrist": (0.1, -0.25, 0.9),
    "right_hip": (0.0, -0.1, 0.9),
    "right_knee": (0.05, -0.1, 0.5),
    "right_ankle": (-0.1, -0.1, 0.1),
    "right_big_toe": (0.05, -0.12, 0.02),
}


def walkers(seed: int = 0, f: int = 30) -> np.ndarray:
    person = np.array([WALKING[name] for name in HUMAN17.keypoints])
    return person + np.random.default_rng(seed).normal(0, 0.02, (f, *person.shape))


def behind(S: np.ndarray, *names: str) -> np.ndarray:
    """Return people of whom some keypoints are behind x = 0 instead of before it."""
    wrong = S.copy()
    wrong[:, [HUMAN17.index(name) for name in names], 0] *= -1
    return wrong


def test_every_vote_of_a_person_is_for_the_way_they_are() -> None:
    assert (np.median(votes(walkers(), HUMAN17), 0) > 0.05).all()


@pytest.mark.parametrize("four", range(len(HUMAN17.handedness)))
@pytest.mark.parametrize("inside_out", [False, True])
def test_one_wrong_vote_is_outvoted(four: int, inside_out: bool) -> None:
    """As a speaker who faces the camera was found: only the nose is where it should be."""
    front = HUMAN17.handedness[four][3]
    S = walkers()
    S[:, HUMAN17.index(front), 0] -= 2 * np.median(votes(S, HUMAN17)[:, four]) * 0.6
    assert np.median(votes(S, HUMAN17)[:, four]) < 0
    if inside_out:
        S = S * MIRROR
    assert is_mirrored(S, HUMAN17) == inside_out
    assert np.linalg.det(object_frame(S, HUMAN17)) == pytest.approx(1 - 2 * inside_out, abs=1e-5)


def test_a_mirrored_ensemble_becomes_the_same_as_the_one_that_is_not() -> None:
    S = behind(walkers(), "nose")
    right, again = S @ object_frame(S, HUMAN17), S * MIRROR @ object_frame(S * MIRROR, HUMAN17)
    np.testing.assert_allclose(votes(again, HUMAN17), votes(right, HUMAN17), atol=1e-5)
    np.testing.assert_allclose(again, right, atol=1e-5)


def test_a_vote_that_is_far_off_in_a_few_frames_does_not_decide() -> None:
    S = walkers()
    S[:12, HUMAN17.index("nose"), 0] -= 100
    assert not is_mirrored(S, HUMAN17)


def test_keypoints_that_nobody_saw_do_not_vote() -> None:
    legs = [name for name in HUMAN17.keypoints if "toe" in name or "knee" in name]
    S = walkers()
    S[:, [HUMAN17.index(name) for name in legs], 0] -= 1  # anywhere
    seen = np.ones(S.shape[:2], bool)
    assert is_mirrored(S, HUMAN17) and is_mirrored(S, HUMAN17, seen)
    seen[:, [HUMAN17.index(name) for name in legs]] = False
    assert not is_mirrored(S, HUMAN17, seen)
    assert np.linalg.det(object_frame(S, HUMAN17, seen)) > 0
    assert is_mirrored(S, HUMAN17, np.zeros_like(seen))  # then all that there is
    seen[:2] = True  # two frames of thirty are no match for the nose
    assert not is_mirrored(S, HUMAN17, seen)


def test_the_first_of_several_gives_the_axes() -> None:
    S = walkers()
    first = KeypointLayout("person", HUMAN17.keypoints, handedness=HUMAN17.handedness[:1])
    np.testing.assert_array_equal(object_frame(S, HUMAN17), object_frame(S, first))


def test_the_share_of_each_front_is_that_of_the_frames_where_it_is_there() -> None:
    S = walkers(f=50)
    most = np.concatenate([behind(S[:48], "nose"), S[48:]])
    shares = front_shares(most, HUMAN17)
    assert [round(100 * share) for _, share in shares] == [4, 100, 100, 100, 100]
    turned = front_shares(most @ rotations(50, np.random.default_rng(0)), HUMAN17)
    assert turned == shares
    assert front_shares(most, KeypointLayout.numbered(len(HUMAN17))) == []


def test_a_part_that_nobody_saw_has_no_share() -> None:
    S = behind(walkers(), "nose")
    seen = np.ones(S.shape[:2], bool)
    assert dict(front_shares(S, HUMAN17, seen))["nose"] == 0
    seen[:, HUMAN17.index("nose")] = False
    assert "nose" not in dict(front_shares(S, HUMAN17, seen))
    seen[0] = True  # one frame of thirty
    assert "nose" not in dict(front_shares(S, HUMAN17, seen))
