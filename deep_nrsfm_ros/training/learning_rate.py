# SPDX-License-Identifier: Apache-2.0
"""The learning rate of each step."""

from __future__ import annotations

import math

from deep_nrsfm_ros.nrsfm.recipe import Recipe


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
