"""The best state that a training has seen, by a quality that needs no label."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from deep_nrsfm_ros.nrsfm.recipe import Recipe
from deep_nrsfm_ros.training.limits import Limits
from deep_nrsfm_ros.training.trainer import Trainer

SHARE = 0.02
"""At most this share of a training's time goes into measuring it."""
_COST = 600  # a look takes as long as training on so many frames
_NOTEWORTHY = 0.01  # relative improvement; less does not count against the patience


def interval(recipe: Recipe) -> int:
    """Return how many steps lie between two looks.

    It goes by the size of a batch instead of by the clock, so that the same seed looks at the
    same states.
    """
    return math.ceil(max(recipe.steps * SHARE, _COST / (recipe.batch * SHARE)))


class BestCheckpoint:
    """Looks at a training now and then; keeps its best weights, and notices a standstill."""

    def __init__(self, limits: Limits, recipe: Recipe) -> None:
        """Look only if the limits make something of it."""
        self.limits = limits
        self.on = limits.keep_best or limits.patience > 0
        self.every = interval(recipe)
        self.weights: Tensor | None = None
        self.quality = self.reference = math.inf
        self.step, self.improved = 0, 0.0
        self.standstill = False

    def look(self, trainer: Trainer) -> None:
        """Measure the trainer if it is time to."""
        if not self.on or not trainer.step or trainer.step % self.every:
            return
        quality = trainer.quality()
        if quality < self.quality:
            self.quality, self.step = quality, trainer.step
            self.weights = trainer.weights.clone()
        if quality < self.reference * (1 - _NOTEWORTHY):
            self.reference, self.improved = quality, trainer.progress
        idle = trainer.progress - self.improved
        self.standstill = 0 < self.limits.patience < idle

    def put_back(self, trainer: Trainer) -> None:
        """Give the trainer the best weights if it shall have them and its own are worse."""
        if not self.limits.keep_best or self.weights is None:
            return
        if not self.quality < trainer.quality():
            return
        with torch.no_grad():
            trainer.weights.copy_(self.weights)
        trainer.kept = self.step

    def state(self) -> dict[str, Tensor]:
        """Return everything that `restore` needs, as named tensors."""
        if self.weights is None:
            return {}
        figures = [self.quality, self.reference, float(self.step), self.improved]
        return {
            "best.weights": self.weights,
            "best.figures": torch.tensor(figures, dtype=torch.float64),
        }

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Take over a `state`, if there is one among the tensors."""
        if "best.weights" not in tensors:
            return
        self.weights = tensors["best.weights"]
        self.quality, self.reference, step, self.improved = tensors["best.figures"].tolist()
        self.step = int(step)
