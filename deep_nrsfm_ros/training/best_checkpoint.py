# SPDX-License-Identifier: Apache-2.0
"""The best weights of a training, by a quality that needs no label."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from deep_nrsfm_ros.nrsfm.recipe import Recipe
from deep_nrsfm_ros.training.early_stopping import patience_exceeded
from deep_nrsfm_ros.training.limits import Limits
from deep_nrsfm_ros.training.trainer import Trainer

SHARE = 0.02
"""Largest share of a training's time that measuring takes."""
_FRAMES_PER_MEASUREMENT = 600  # frames whose training takes as long as one measurement
_MIN_IMPROVEMENT = 0.01  # relative; less does not count against the patience


def steps_between(recipe: Recipe) -> int:
    """Return the number of steps from one measurement to the next.

    It follows from the size of a batch instead of the clock, so that the same seed measures the
    same states.
    """
    return math.ceil(max(recipe.steps * SHARE, _FRAMES_PER_MEASUREMENT / (recipe.batch * SHARE)))


class BestCheckpoint:
    """Measures a training at intervals and keeps its best weights.

    Attributes:
        enabled: whether the limits ask for the best weights or set a patience.
        weights: (n,) the best weights, None before the first measurement.
        quality: of the best weights, as of `Trainer.quality`.
        step: of the best weights.
        patience_exceeded: whether the quality has not improved for longer than the patience.
    """

    def __init__(self, limits: Limits, recipe: Recipe) -> None:
        """Start without weights."""
        self.limits = limits
        self.enabled = limits.keep_best or limits.patience > 0
        self.interval = steps_between(recipe)
        self.weights: Tensor | None = None
        self.quality = self.reference = math.inf
        self.step, self.last_improvement = 0, 0.0
        self.patience_exceeded = False

    def update(self, trainer: Trainer) -> None:
        """Measure the trainer if its step is one of the interval, and keep the better weights."""
        if not self.enabled or not trainer.step or trainer.step % self.interval:
            return
        quality = trainer.quality()
        if quality < self.quality:
            self.quality, self.step = quality, trainer.step
            self.weights = trainer.weights.clone()
        if quality < self.reference * (1 - _MIN_IMPROVEMENT):
            self.reference, self.last_improvement = quality, trainer.progress
        self.patience_exceeded = patience_exceeded(
            self.limits, trainer.progress, self.last_improvement
        )

    def restore_best(self, trainer: Trainer) -> None:
        """Set the trainer to the best weights if the limits ask for it and its own are worse."""
        if not self.limits.keep_best or self.weights is None:
            return
        if not self.quality < trainer.quality():
            return
        with torch.no_grad():
            trainer.weights.copy_(self.weights)
        trainer.kept_step = self.step

    def state(self) -> dict[str, Tensor]:
        """Return all that `restore` needs, as named tensors."""
        if self.weights is None:
            return {}
        figures = [self.quality, self.reference, float(self.step), self.last_improvement]
        return {
            "best.weights": self.weights,
            "best.figures": torch.tensor(figures, dtype=torch.float64),
        }

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Set to a saved state, if there is one among the tensors."""
        if "best.weights" not in tensors:
            return
        self.weights = tensors["best.weights"]
        figures = tensors["best.figures"].tolist()
        self.quality, self.reference, step, self.last_improvement = figures
        self.step = int(step)
