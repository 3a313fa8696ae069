# SPDX-License-Identifier: Apache-2.0
"""The number of steps where none is given."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deep_nrsfm_ros.nrsfm.network import Architecture, Network, initialise
from deep_nrsfm_ros.nrsfm.recipe import AUTOMATIC, Recipe
from deep_nrsfm_ros.training.steps import FROM_RANDOM, with_steps

OTHER_KEYPOINTS = initialise(Architecture(widths=(4,)), 5, np.random.default_rng(0))
START = dataclasses.replace(OTHER_KEYPOINTS, L=2 * OTHER_KEYPOINTS.L)


def steps(frames: int, start: Network | None = START, given: int = AUTOMATIC) -> int:
    return with_steps(Recipe(steps=given), frames, start).steps


def test_a_training_from_a_model_takes_few_steps_and_more_for_more_frames() -> None:
    counts = [steps(frames) for frames in (1, 100, 1000, 10_000, 100_000, 10_000_000)]
    assert counts == sorted(counts) and counts[0] > 0
    assert counts[2] < FROM_RANDOM / 10 and counts[-1] == FROM_RANDOM


def test_a_training_of_few_frames_takes_few_steps() -> None:
    assert [steps(frames) for frames in (1, 300, 411)] == [100, 100, 137]
    assert [steps(frames, OTHER_KEYPOINTS) for frames in (1, 411)] == [1000, 1370]


@pytest.mark.parametrize("frames", [1, 1000, 10_000_000])
def test_other_keypoints_need_more(frames: int) -> None:
    assert steps(frames) <= steps(frames, OTHER_KEYPOINTS) <= steps(frames, None) == FROM_RANDOM
    assert steps(1) < steps(1, OTHER_KEYPOINTS)


def test_a_number_that_is_given_stays() -> None:
    assert [steps(500, start, 7) for start in (None, START)] == [7, 7] and not steps(500, given=0)
