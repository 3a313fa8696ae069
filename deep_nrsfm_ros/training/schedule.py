# SPDX-License-Identifier: Apache-2.0
"""The schedule of a training: number of steps, learning rate of each, share of exchanged limbs."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from deep_nrsfm_ros.nrsfm.network import Network
from deep_nrsfm_ros.nrsfm.recipe import AUTOMATIC, Recipe
from deep_nrsfm_ros.training.limb_exchange import LimbExchange

FROM_RANDOM = 30_000
"""Steps of a training from random weights, and the most of one that starts from a model."""
_FRAMES_A_STEP = 3  # of a training that starts from a model: 64 a batch are 21 passes over them
_MIN_STEPS = 300  # of a training that starts from a model
_WITHOUT_WHITENING = 10  # times as many steps, as new keypoints are learned from nothing


def with_steps(recipe: Recipe, frames: int, start: Network | None) -> Recipe:
    """Return the recipe with the number of its steps in place of `AUTOMATIC`.

    A trained network has learned what shapes there are, so that about 21 passes over the new frames
    suffice; with more it fits their noise. `benchmarks/real/fine_tuning.py` compares numbers.

    Args:
        recipe: whose steps may be `AUTOMATIC`.
        frames: of all processes.
        start: the network that the training starts from, as `fine_tuning.start_from` returns it.
            None: random weights.
    """
    if recipe.steps != AUTOMATIC:
        return recipe
    wanted = FROM_RANDOM
    if start is not None:
        wanted = max(frames // _FRAMES_A_STEP, _MIN_STEPS)
        if lacks_whitening(start):
            wanted *= _WITHOUT_WHITENING
    return dataclasses.replace(recipe, steps=min(wanted, FROM_RANDOM))


def with_limb_exchange(
    recipe: Recipe, start: Network | None, limb_exchange: LimbExchange | None
) -> Recipe:
    """Return the recipe with the share of shapes with exchanged limbs in place of `AUTOMATIC`.

    Frames of a training that starts from a model are often of one person or of few motions, from
    which the network would learn that limbs move together.

    Args:
        recipe: whose `limb_exchange` may be `AUTOMATIC`.
        start: the network that the training starts from; None: random weights.
        limb_exchange: the limbs of the layout; None: it has none.

    Raises:
        ValueError: the recipe exchanges limbs, and the layout has none; or the share is no share.
    """
    share = recipe.limb_exchange
    check_limb_exchange(share)
    if share == AUTOMATIC:
        share = float(start is not None and limb_exchange is not None)
    if share and limb_exchange is None:
        raise ValueError(
            f"limb_exchange is {share:g}, but there are no limbs to exchange: no edge of the "
            "layout divides it"
        )
    return dataclasses.replace(recipe, limb_exchange=share)


def check_limb_exchange(share: float, name: str = "limb_exchange") -> None:
    """Raise ValueError unless a share is `AUTOMATIC` or from 0 to 1.

    Args:
        share: `Recipe.limb_exchange`.
        name: of the option, for the message.
    """
    if share != AUTOMATIC and not 0 <= share <= 1:
        raise ValueError(f"{name} is {share:g}; it must be {AUTOMATIC} or from 0 to 1")


def lacks_whitening(start: Network) -> bool:
    """Return whether a start, as `fine_tuning.start_from` returns it, is not whitened.

    It is not where its keypoints are not those of its model, or where the model has no whitening.
    """
    return np.array_equal(start.L, np.eye(start.p))


def learning_rate(recipe: Recipe, step: float, time_fraction: float = 0.0) -> float:
    """Return the learning rate of a step.

    Args:
        recipe: gives the schedule.
        step: steps taken.
        time_fraction: elapsed fraction of the time limit; the schedule is at least that far, so
            that it ends with the time.
    """
    step = max(step, min(time_fraction, 1.0) * recipe.steps)
    if recipe.schedule == "exponential":
        return recipe.learning_rate * float(0.95 ** (step / 10000))
    return recipe.learning_rate * 0.5 * (1 + math.cos(math.pi * step / recipe.steps))
