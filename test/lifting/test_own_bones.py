# SPDX-License-Identifier: Apache-2.0
"""The bones of a made person are learned, and forgotten when another one takes the identity."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.lifting.own_bones import (
    MEMORY,
    Learned,
    Sight,
    in_reference_units,
    learn,
    measure,
    named_lengths,
    own_bones,
    own_growth,
    partner_bones,
)
from deep_nrsfm_ros.nrsfm.bones import Bones

ENDS = np.array(HUMAN17.bone_indices(), np.int32).T
B = len(ENDS[0])
LENGTHS = np.random.default_rng(0).uniform(0.02, 0.08, B)
BONES = Bones(ENDS, LENGTHS / LENGTHS.sum(), 0.08 * LENGTHS / LENGTHS.sum())
PARTNERS = partner_bones(ENDS, HUMAN17.sides())
TIME, RATE = 0.3, 25


def person(seed: int) -> np.ndarray:
    """Return the growth (b,) of a made person's bones, the same on both sides, of no growth."""
    growth = np.random.default_rng(seed).normal(0, 0.2, B)
    growth = (growth + growth[PARTNERS]) / 2
    growth[:] -= growth.mean()  # all have the same precision
    return growth


def frames(growth: np.ndarray, n: int, seed: int, noise: float = 0.05) -> list[Sight]:
    """Return how n frames show a person, at an unknown size, some bones foreshortened."""
    rng = np.random.default_rng(seed)
    sizes, noises = rng.normal(0, 0.5, n), rng.normal(0, noise, (n, B))
    weights = rng.uniform(0, 1, (n, B)) * (rng.random((n, B)) < 0.8)
    return [
        Sight((growth + s + e)[None], w[None])
        for s, e, w in zip(sizes, noises, weights, strict=True)
    ]


def start() -> Learned:
    return Learned(np.zeros((1, B)), np.zeros((1, B)), np.zeros((1, 2)))


def watch(learned: Learned, sights: list[Sight], seconds: float = 1 / RATE) -> Learned:
    for sight in sights:
        learned = learn(BONES, PARTNERS, learned, sight, np.array([seconds]), TIME)
    return learned


def error(learned: Learned, truth: np.ndarray) -> float:
    return float(np.abs(own_growth(BONES, learned, TIME)[0] - truth).mean())


def test_partners_are_the_bones_of_the_other_side() -> None:
    names = [frozenset(HUMAN17.keypoints[i] for i in bone) for bone in ENDS.T]
    for bone, other in zip(names, PARTNERS, strict=True):
        swap = {
            n: n.replace("left", "?").replace("right", "left").replace("?", "right") for n in bone
        }
        assert names[other] == frozenset(swap.values())


def test_bones_converge_to_those_of_the_person() -> None:
    truth = person(1)
    before = np.abs(truth).mean()
    half_a_second = watch(start(), frames(truth, RATE // 2, 2))
    seconds = watch(start(), frames(truth, 8 * RATE, 2))
    assert error(half_a_second, truth) < 0.7 * before
    assert error(seconds, truth) < 0.15 * before
    bones = own_bones(BONES, seconds, TIME)
    ratio = bones.lengths[0] / (BONES.lengths * np.exp(truth))
    assert ratio == pytest.approx(np.full(B, ratio.mean()), rel=0.05)
    assert (bones.spread < 0.6 * BONES.spread).all() and (bones.spread > 0.4 * BONES.spread).all()


def test_nothing_learned_is_the_model() -> None:
    bones = own_bones(BONES, start(), TIME)
    np.testing.assert_array_equal(bones.lengths[0], BONES.lengths)
    np.testing.assert_array_equal(bones.spread[0], BONES.spread)
    off = own_bones(BONES, watch(start(), frames(person(1), 50, 0)), 0.0)
    np.testing.assert_array_equal(off.lengths[0], BONES.lengths)


@pytest.mark.parametrize("seed", [1, 3, 5])
def test_another_person_is_learned_within_a_second(seed: int) -> None:
    first = person(seed)
    second = -first  # nobody is misjudged more by what was learned of the first
    learned = watch(start(), frames(first, 10 * RATE, seed))
    assert learned.evidence.max() > 2 and error(learned, second) > 1.7 * np.abs(second).mean()
    learned = watch(learned, frames(second, RATE, seed + 1))
    assert learned.evidence.max() < 1.5, "the change was not seen"
    assert error(learned, second) < np.abs(second).mean(), "worse than the model's bones"


def test_the_same_person_is_not_taken_for_another() -> None:
    learned = start()
    for sight in frames(person(1), 60 * RATE, 3, noise=0.15):
        before = learned.evidence.max()
        learned = watch(learned, [sight])
        assert learned.evidence.max() >= before
    assert learned.evidence.max() <= MEMORY


def test_a_bone_measured_wrong_is_no_growth_of_the_others() -> None:
    truth = person(1)
    sights = frames(truth, 8 * RATE, 2)
    for sight in sights:
        sight.growth[0, 5] += 3
    found = own_growth(BONES, watch(start(), sights), TIME)[0]
    others = np.delete(np.arange(B), [5, PARTNERS[5]])
    assert np.abs((found - truth - np.median(found - truth))[others]).mean() < 0.03


def test_what_is_not_seen_changes_nothing_and_a_gap_is_no_evidence() -> None:
    learned = watch(start(), frames(person(1), 50, 2))
    hidden = Sight(np.full((1, B), -40.0), np.zeros((1, B)))
    after = watch(learned, [hidden])
    for part, same in zip(after, learned, strict=True):
        np.testing.assert_array_equal(part, same)
    (sight,) = frames(person(1), 1, 9)
    late = watch(learned, [sight], seconds=1000.0)
    assert (late.evidence - learned.evidence).max() <= 0.1 + 1e-12


def test_bones_are_measured_best_across_the_line_of_sight() -> None:
    X = np.random.default_rng(0).standard_normal((3, 17, 3))
    R = Rotation.random(3, random_state=1).as_matrix()
    weight = np.random.default_rng(1).random((3, 17))
    weight[:, 4] = 0
    sight = measure(BONES, X, R, weight)
    for n, b in np.ndindex(3, B):
        i, j = ENDS[:, b]
        edge = R[n] @ (X[n, i] - X[n, j])
        across = np.linalg.norm(edge[:2]) / np.linalg.norm(edge)
        assert sight.weight[n, b] == pytest.approx(across**8 * min(weight[n, i], weight[n, j]))
        length = np.exp(sight.growth[n, b]) * BONES.lengths[b]
        assert length == pytest.approx(np.linalg.norm(edge))


def test_lengths_in_units_of_the_reference() -> None:
    ends, lengths = np.array([[0, 1, 2], [1, 2, 3]], np.int32), np.array([2.0, 4.0, 8.0])
    for pair in ((1, 2), (2, 1)):
        assert in_reference_units(lengths, ends, pair, 0.5).tolist() == [0.25, 0.5, 1]
    assert in_reference_units(lengths, ends, (0, 3), 0.5).tolist() == [2, 4, 8]  # no bone joins it


def test_only_chosen_bones_are_named() -> None:
    ends, chosen = np.array([[0, 1, 2], [1, 2, 3]], np.int32), np.array([True, False, True])
    found = named_lengths(np.array([1.0, 2.0, 3.0]), ends, ("hip", "knee", "heel", "toe"), chosen)
    assert found == {"hip-knee": 1, "heel-toe": 3}
