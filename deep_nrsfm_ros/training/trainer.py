# SPDX-License-Identifier: Apache-2.0
"""The training of one initialisation: its steps, its label-free errors and its saved state."""

from __future__ import annotations

import dataclasses
import math
import time
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deep_nrsfm_ros.nrsfm.factorisation.consensus import Consensus
from deep_nrsfm_ros.nrsfm.losses import Batch, Objective
from deep_nrsfm_ros.nrsfm.network import initialise, whitening
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import Preset
from deep_nrsfm_ros.training.adam import Adam
from deep_nrsfm_ros.training.distributed import ALONE, ProcessGroup
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.gradient_function import (
    GradientFunction,
    weight_vector,
    with_weights,
)
from deep_nrsfm_ros.training.learning_rate import learning_rate
from deep_nrsfm_ros.training.setup import DEFAULT_SETUP, Setup
from deep_nrsfm_ros.training.soap import Soap


class KnownShapes(NamedTuple):
    """Shapes of the cycle loss, which the network must return from their images.

    Attributes:
        shapes: (c, p, 3).
        cameras: (k, 2, 3) M^T of the first k shapes, those of their frames; the others are seen by
            random cameras. None: all are.
    """

    shapes: Tensor
    cameras: Tensor | None = None

    def to(self, device: torch.device) -> KnownShapes:
        """Return the shapes and cameras on a device."""
        cameras = None if self.cameras is None else self.cameras.to(device)
        return KnownShapes(self.shapes.to(device), cameras)


class Trainer:
    """One initialisation in training: network, optimiser and step.

    The random numbers of a step depend on the seed, the step and the process alone, so a resumed
    training computes the same bits as one that was not stopped, with the same number of threads
    on the same kind of processor. A resumed group starts from the shapes of the first process's
    last batch.

    Attributes:
        net: the network; its learned weights are views of `weights`.
        weights: (n,) all learned weights.
        known: known shapes of the next step's cycle loss: the network's own of the last batch,
            unless others are set before the step; None at first.
        step: steps taken.
        time_fraction: fraction of the time limit that has elapsed, 0 without a limit.
        kept_step: step of the weights where they are not those of the last step, else None.
        end_reason: why the training has ended; "" if it was stopped or goes on.
        mirrored_share: share of frames with mirrored depth at the end, 0 to 0.5; NaN unknown.
        factorisation: shapes of the frames that the network is taught; None: none.
        minutes_needed: time limit with which the factorisations would have come to their end; 0
            where none cut them short.
        from_random: whether the training began with random weights.
        total_frames: frames of all processes.
        cpu_seconds: processor time of this process in steps.
    """

    def __init__(
        self,
        frames: FrameStore,
        preset: Preset,
        seed: int,
        setup: Setup = DEFAULT_SETUP,
        factorisation: Consensus | None = None,
    ) -> None:
        """Initialise the network, and whiten it by the frames unless it has a whitening.

        Args:
            frames: those of this process.
            preset: architecture, normaliser and recipe.
            seed: of the initialisation and of all steps.
            setup: start, layout loss, limbs and processes. All processes make their trainers and
                take their steps at the same time.
            factorisation: shapes of the frames that the network is taught.
        """
        architecture, normaliser, recipe = preset
        start, group = setup.start, setup.group
        self.frames, self.preset, self.seed, self.step = frames, preset, seed, 0
        self.group, self.batch = group, group.share(preset.recipe.batch)
        self.cpu_seconds = 0.0
        count = torch.tensor(len(frames), device=frames.device)
        group.sum_in_place(count)
        self.total_frames = int(count)
        self.time_fraction = 0.0
        self.kept_step: int | None = None
        self.end_reason = ""
        self.mirrored_share = math.nan
        self.factorisation, self.minutes_needed = factorisation, 0.0
        self.from_random = start is None
        self._limb_exchange = setup.limb_exchange
        device = frames.device
        initial = start or initialise(
            architecture,
            frames.points.shape[1],
            np.random.default_rng(seed),
            paper_initialisation=recipe.paper_initialisation,
        )
        if architecture.whitening and np.array_equal(initial.L, np.eye(initial.p)):
            moment = second_moment(frames, normaliser, group)
            exponent, floor = architecture.whitening, architecture.whitening_floor
            L, L_inverse = whitening(moment, exponent, floor)
            initial = dataclasses.replace(initial, L=L, L_inverse=L_inverse)
        self.initial = initial.map(lambda w: torch.from_numpy(w).to(device))
        # One tensor of all weights, since Adam on fifty tensors takes twice as long.
        self.weights = weight_vector(self.initial)
        self.net = with_weights(self.initial, self.weights)
        self.optimiser: Adam | Soap = Adam(self.weights)
        if recipe.optimiser == "soap":
            shapes = [weight.shape for _, weight in self.initial.trainable_weights()]
            self.optimiser = Soap(self.weights, shapes, group)
        self.objective = Objective(normaliser, recipe, layout_loss=setup.layout_loss)
        self.gradient_function = GradientFunction(self.objective, self.net, self.batch)
        plain = dataclasses.replace(recipe, added_noise=0.0, mask=0.0, cycle=1.0)
        self.plain_objective = Objective(normaliser, plain, whitened=False)
        self.generator = torch.Generator(device)
        self.known: KnownShapes | None = None
        self.probe = self.sample(1024)

    @property
    def progress(self) -> float:
        """Return the fraction of the steps or of the time limit that is over, the larger one."""
        return max(self.step / max(self.preset.recipe.steps, 1), min(self.time_fraction, 1.0))

    def sample(self, size: int, step: int = -1) -> Batch:
        """Return the random batch of a step, and leave the generator seeded for its cameras.

        Args:
            size: frames of the batch.
            step: -1 for frames that no step takes.
        """
        self.generator.manual_seed((self.seed << 32) + (self.group.rank << 24) + step + 1)
        frames, generator = self.frames, self.generator
        return frames.batch(
            torch.randint(len(frames), (size,), generator=generator, device=frames.device)
        )

    def recombined(self) -> KnownShapes | None:
        """Return the `known` shapes, with exchanged limbs in the recipe's share of them.

        Shapes with a camera of their own stay as they are: it sees the frame.
        """
        if self.known is None or self._limb_exchange is None:
            return self.known
        shapes, cameras = self.known
        share = self.preset.recipe.limb_exchange * max(1 - self.progress, 0.0)
        kept = 0 if cameras is None else len(cameras)
        count = min(round(share * len(shapes)), len(shapes) - kept)
        if not count:
            return self.known
        rng = np.random.default_rng((self.seed, self.group.rank, self.step))
        without_camera_first = shapes.roll(-kept, 0).cpu().numpy()
        recombined = self._limb_exchange.recombine(without_camera_first, count, rng)
        result = shapes.clone()
        result[kept : kept + count] = torch.from_numpy(recombined.astype(np.float32))
        return KnownShapes(result, cameras)

    def advance(self) -> None:
        """Take one gradient step."""
        with self.gradient_function.threads():
            self._advance()

    def _advance(self) -> None:
        began = time.process_time()
        batch = self.sample(self.batch, self.step)
        shapes, cameras = self.recombined() or (None, None)
        losses, gradient = self.gradient_function(
            self.weights, batch, shapes, self.generator, cameras
        )
        self.known = KnownShapes(losses.shapes)
        if self.group.size > 1:
            gradient = gradient * (self.batch / self.preset.recipe.batch)
            self.group.sum_in_place(gradient)
        rate = learning_rate(self.preset.recipe, self.step, self.time_fraction)
        self.optimiser.update(gradient, rate)
        self.step += 1
        self.cpu_seconds += time.process_time() - began

    @torch.no_grad()
    def measure(self) -> tuple[float, float]:
        """Return reprojection error and cycle error on 1024 fixed frames of this process.

        Both are relative, 0 being perfect; without augmentation and whitening.
        """
        self.generator.manual_seed(self.seed)
        shapes = self.plain_objective(self.net, self.probe, None, self.generator).shapes
        losses = self.plain_objective(self.net, self.probe, shapes, self.generator)
        return float(losses.reprojection), float(losses.cycle)

    def quality(self) -> float:
        """Return the root of the squared sum of both errors of `measure`; less is better.

        The errors are means over the group, so all its processes call this at the same step.
        """
        return math.hypot(*self.group.mean(self.measure()))

    @torch.no_grad()
    def average_with_start(self, share: float) -> None:
        """Set the weights to the weighted mean of those of the start and the trained ones.

        The mean keeps most of what the training has gained on its frames, and on other frames most
        of what the start could do.

        Args:
            share: weight of the start, 0 to 1.

        Source: Wortsman et al., "Robust fine-tuning of zero-shot models", CVPR 2022.
        """
        self.weights.lerp_(weight_vector(self.initial), share)

    def state(self) -> dict[str, Tensor]:
        """Return all that `restore` needs, as named tensors."""
        tensors = {name: torch.tensor(getattr(self, name)) for name in _COUNTS}
        tensors |= {"weights": self.weights, "L": self.initial.L}
        if self.known is not None:
            tensors["shapes"] = self.known.shapes
        moments = self.optimiser.moments
        return tensors | {f"moments.{key}": value for key, value in moments.items()}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Set the trainer to a saved state.

        Raises:
            ValueError: the state is of another architecture, other data or another start.
        """
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
            self.known = KnownShapes(tensors["shapes"].to(device))
        self.optimiser.restore(
            {
                name.removeprefix("moments."): value
                for name, value in tensors.items()
                if name.startswith("moments.")
            }
        )
        self.probe = self.sample(1024)


_COUNTS = {"step", "seed", "cpu_seconds"}


def second_moment(
    frames: FrameStore, normaliser: Normaliser, group: ProcessGroup = ALONE
) -> NDArray[np.float64]:
    """Return E[W W^T] (p, p) of normalised keypoints W, over the frames of all processes.

    Each entry is the mean over the frames in which both points are visible, 0 if there are none.
    """
    total = count = torch.zeros(())
    for points, mask in frames.batches():
        # One product for all frames is seven times as fast as one for each.
        W = normaliser.encode(points, mask).W.mT.reshape(-1, points.shape[1]).double()
        visible = mask[..., 0].double()
        total, count = total + W.T @ W, count + visible.T @ visible
    group.sum_in_place(total, count)
    moment = (total / count.clamp(min=1)).cpu().numpy()
    return np.asarray(moment, np.float64)
