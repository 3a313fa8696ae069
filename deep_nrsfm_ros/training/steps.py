# SPDX-License-Identifier: Apache-2.0
"""The number of steps of a training."""

from __future__ import annotations

import dataclasses

import numpy as np

from deep_nrsfm_ros.nrsfm.network import Network
from deep_nrsfm_ros.nrsfm.recipe import AUTOMATIC, Recipe

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


def lacks_whitening(start: Network) -> bool:
    """Return whether a start, as `fine_tuning.start_from` returns it, is not whitened.

    It is not where its keypoints are not those of its model, or where the model has no whitening.
    """
    return np.array_equal(start.L, np.eye(start.p))
