# SPDX-License-Identifier: Apache-2.0
"""The number of steps of a training."""

from __future__ import annotations

import dataclasses

from deep_nrsfm_ros.nrsfm.network import Network
from deep_nrsfm_ros.nrsfm.recipe import AUTOMATIC, Recipe
from deep_nrsfm_ros.training.fine_tuning import steps_from

FROM_RANDOM = 30_000
"""Steps of a training from random weights, and the most of one that starts from a model."""


def with_steps(recipe: Recipe, frames: int, start: Network | None) -> Recipe:
    """Return the recipe with the number of its steps in place of `AUTOMATIC`.

    Args:
        recipe: whose steps may be `AUTOMATIC`.
        frames: of all processes.
        start: the network that the training starts from, as `fine_tuning.start_from` returns it.
            None: random weights.
    """
    if recipe.steps != AUTOMATIC:
        return recipe
    wanted = FROM_RANDOM if start is None else steps_from(start, frames)
    return dataclasses.replace(recipe, steps=min(wanted, FROM_RANDOM))
