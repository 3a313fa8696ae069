"""One initialisation in training: what a step does, and what it needs to go on later."""

from __future__ import annotations

import dataclasses
import math
import time

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deep_nrsfm_ros.nrsfm.layout_loss import LayoutLoss
from deep_nrsfm_ros.nrsfm.losses import Batch, Objective
from deep_nrsfm_ros.nrsfm.network import Network, initialise, whitening
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import Preset, Recipe
from deep_nrsfm_ros.training.adam import Adam
from deep_nrsfm_ros.training.distributed import ALONE, ProcessGroup
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.gradient_function import (
    GradientFunction,
    weight_vector,
    with_weights,
)


class Trainer:
    """One initialisation in training: network, optimiser and step, all of it resumable.

    The randomness of a step depends on the seed and the step alone, so a training resumed from a
    checkpoint goes on exactly as if it had not stopped, on as many threads of such a processor:
    others add up in another order. In a team it depends on the process too,
    and all go on with the shapes of the first one's last batch.
    """

    def __init__(
        self,
        frames: FrameStore,
        preset: Preset,
        seed: int,
        start: Network | None = None,
        team: ProcessGroup = ALONE,
        layout_loss: LayoutLoss | None = None,
    ) -> None:
        """Initialise the network from `seed`, or take that of `start`.

        Either is whitened by the frames, unless it has a whitening already. `frames` are those of
        this process; all processes of a team make their trainers and take their steps together.
        """
        architecture, normaliser, recipe = preset
        self.frames, self.preset, self.seed, self.step = frames, preset, seed, 0
        self.team, self.batch = team, team.share(preset.recipe.batch)
        self.cpu_seconds = 0.0
        count = torch.tensor(len(frames), device=frames.device)
        team.total(count)
        self.frames_in_all = int(count)
        self.time_gone = 0.0  # share of the time there is, if that is limited
        self.kept: int | None = None  # the step of the weights, where that is not the last one
        self.ended = ""  # why there is nothing left to be done; "" if it was stopped
        device = frames.device
        initial = start or initialise(
            architecture,
            frames.points.shape[1],
            np.random.default_rng(seed),
            paper_initialisation=recipe.paper_initialisation,
        )
        if architecture.whitening and np.array_equal(initial.L, np.eye(initial.p)):
            moment = second_moment(frames, normaliser, team)
            exponent, floor = architecture.whitening, architecture.whitening_floor
            L, L_inverse = whitening(moment, exponent, floor)
            initial = dataclasses.replace(initial, L=L, L_inverse=L_inverse)
        self.initial = initial.map(lambda w: torch.from_numpy(w).to(device))
        # All weights in one tensor: Adam costs a tenth of a step on one, a fifth on fifty.
        self.weights = weight_vector(self.initial)
        self.net = with_weights(self.initial, self.weights)
        self.optimiser = Adam(self.weights)
        self.objective = Objective(normaliser, recipe, layout_loss=layout_loss)
        self.gradient_function = GradientFunction(self.objective, self.net, self.batch)
        plain = dataclasses.replace(recipe, noise=0.0, mask=0.0, cycle=1.0)
        self.plain_objective = Objective(normaliser, plain, whitened=False)
        self.generator = torch.Generator(device)
        self.shapes: Tensor | None = None  # of the last batch, for the cycle loss
        self.probe = self.sample(1024)

    @property
    def progress(self) -> float:
        """Return how much of the training is over, 0 to 1: of its steps, or of its time."""
        return max(self.step / self.preset.recipe.steps, min(self.time_gone, 1.0))

    def sample(self, size: int, step: int = -1) -> Batch:
        """Return the random batch of a step; leaves the generator ready for its cameras."""
        self.generator.manual_seed((self.seed << 32) + (self.team.rank << 24) + step + 1)
        pool, generator = self.frames, self.generator
        return pool.batch(
            torch.randint(len(pool), (size,), generator=generator, device=pool.device)
        )

    def advance(self) -> None:
        """Take one gradient step."""
        with self.gradient_function.threads():
            self._advance()

    def _advance(self) -> None:
        began = time.process_time()
        batch = self.sample(self.batch, self.step)
        losses, gradient = self.gradient_function(self.weights, batch, self.shapes, self.generator)
        self.shapes = losses.shapes
        if self.team.size > 1:
            gradient = gradient * (self.batch / self.preset.recipe.batch)
            self.team.total(gradient)
        rate = learning_rate(self.preset.recipe, self.step, self.time_gone)
        self.optimiser.update(gradient, rate)
        self.step += 1
        self.cpu_seconds += time.process_time() - began

    @torch.no_grad()
    def measure(self) -> tuple[float, float]:
        """Return (reprojection error, cycle error) on fixed frames without augmentation.

        The frames are those of this process.
        """
        self.generator.manual_seed(self.seed)
        shapes = self.plain_objective(self.net, self.probe, None, self.generator).shapes
        losses = self.plain_objective(self.net, self.probe, shapes, self.generator)
        return float(losses.reprojection), float(losses.cycle)

    def quality(self) -> float:
        """Return the label-free quality, less being better: both errors of `measure` combined.

        The errors are means over the team, so all processes of it ask together.
        """
        return math.hypot(*self.team.mean(self.measure()))

    def state(self) -> dict[str, Tensor]:
        """Return everything that `restore` needs, as named tensors."""
        tensors = {name: torch.tensor(getattr(self, name)) for name in _COUNTS}
        tensors |= {"weights": self.weights, "L": self.initial.L}
        if self.shapes is not None:
            tensors["shapes"] = self.shapes
        moments = self.optimiser.moments
        return tensors | {f"adam.{key}": value for key, value in moments.items()}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Take over a `state`; raise ValueError if it is not of this architecture."""
        saved = tensors.get("weights")
        if saved is None or saved.shape != self.weights.shape or not _COUNTS <= tensors.keys():
            raise ValueError("the checkpoint is not of a training of this network; delete it")
        L: Tensor = self.initial.L
        if not torch.allclose(tensors.get("L", L).to(L.device), L, 1e-3, 1e-3):
            raise ValueError("the checkpoint is of other data or another model to start from")
        self.step, self.seed = int(tensors["step"]), int(tensors["seed"])
        self.cpu_seconds = float(tensors["cpu_seconds"])
        device = self.weights.device
        with torch.no_grad():
            self.weights.copy_(saved)
        if "shapes" in tensors:
            self.shapes = tensors["shapes"].to(device)
        self.optimiser.restore(
            {
                name.removeprefix("adam."): value
                for name, value in tensors.items()
                if name.startswith("adam.")
            }
        )
        self.probe = self.sample(1024)


_COUNTS = {"step", "seed", "cpu_seconds"}


def second_moment(
    frames: FrameStore, normaliser: Normaliser, team: ProcessGroup = ALONE
) -> NDArray[np.float64]:
    """Return E[W W^T] (p, p), each entry over the frames in which both points are visible.

    The frames are those of all processes.
    """
    total = seen = torch.zeros(())
    for points, mask in frames.blocks():
        # One product for all frames: one a frame took seven times as long.
        W = normaliser.encode(points, mask).W.mT.reshape(-1, points.shape[1]).double()
        there = mask[..., 0].double()
        total, seen = total + W.T @ W, seen + there.T @ there
    team.total(total, seen)
    moment = (total / seen.clamp(min=1)).cpu().numpy()
    return np.asarray(moment, np.float64)


def learning_rate(recipe: Recipe, step: float, time_gone: float = 0.0) -> float:
    """Return the learning rate of a step by the recipe's schedule.

    It is at least as far as the share of the time that is gone, so that it ends with the time.
    """
    step = max(step, min(time_gone, 1.0) * recipe.steps)
    if recipe.schedule == "exponential":
        return recipe.learning_rate * float(0.95 ** (step / 10000))
    return recipe.learning_rate * 0.5 * (1 + math.cos(math.pi * step / recipe.steps))
