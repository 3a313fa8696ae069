# SPDX-License-Identifier: Apache-2.0
"""The number of steps and the share of exchanged limbs where none is given."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deep_nrsfm_ros.layouts.presets import CMU31
from deep_nrsfm_ros.nrsfm.network import Architecture, Network, initialise
from deep_nrsfm_ros.nrsfm.recipe import AUTOMATIC, Recipe
from deep_nrsfm_ros.training.limb_exchange import LimbExchange
from deep_nrsfm_ros.training.schedule import FROM_RANDOM, with_limb_exchange, with_steps

OTHER_KEYPOINTS = initialise(Architecture(widths=(4,)), 5, np.random.default_rng(0))
START = dataclasses.replace(OTHER_KEYPOINTS, L=2 * OTHER_KEYPOINTS.L)


def steps(frames: int, start: Network | None = START, given: int = AUTOMATIC) -> int:
    return with_steps(Recipe(steps=given), frames, start).steps


def test_a_training_from_a_model_takes_few_steps_and_more_for_more_frames() -> None:
    counts = [steps(frames) for frames in (1, 100, 1000, 10_000, 100_000, 10_000_000)]
    assert counts == sorted(counts) and counts[0] > 0
    assert counts[2] < FROM_RANDOM / 10 and counts[-1] == FROM_RANDOM


@pytest.mark.parametrize("frames", [1, 1000, 10_000_000])
def test_other_keypoints_need_more(frames: int) -> None:
    assert steps(frames) <= steps(frames, OTHER_KEYPOINTS) <= steps(frames, None) == FROM_RANDOM
    assert steps(1) < steps(1, OTHER_KEYPOINTS)


def test_a_number_that_is_given_stays() -> None:
    assert [steps(500, start, 7) for start in (None, START)] == [7, 7] and not steps(500, given=0)


@pytest.mark.parametrize(
    ("asked", "from_model", "has_limbs", "taken"),
    [
        (AUTOMATIC, True, True, 1),
        (AUTOMATIC, True, False, 0),
        (AUTOMATIC, False, True, 0),
        (0.5, False, True, 0.5),
        (0, True, True, 0),
    ],
)
def test_limbs_are_exchanged_by_themselves_only_where_a_model_is_the_start(
    asked: float, from_model: bool, has_limbs: bool, taken: float
) -> None:
    limbs = LimbExchange(CMU31) if has_limbs else None
    recipe = with_limb_exchange(Recipe(limb_exchange=asked), START if from_model else None, limbs)
    assert recipe.limb_exchange == taken


def test_limbs_that_a_layout_lacks_cannot_be_exchanged() -> None:
    with pytest.raises(ValueError, match="limb_exchange is 1, but there are no limbs to exchange"):
        with_limb_exchange(Recipe(limb_exchange=1), START, None)


@pytest.mark.parametrize("share", [-0.5, -2, 1.5])
def test_a_share_that_is_no_share_is_refused(share: float) -> None:
    with pytest.raises(ValueError, match=f"limb_exchange is {share}; it must be -1 or from 0 to 1"):
        with_limb_exchange(Recipe(limb_exchange=share), START, LimbExchange(CMU31))
