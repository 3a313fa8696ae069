"""Training: seeds screened, the best trained on, from 2D keypoints alone."""

from __future__ import annotations

import dataclasses
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from deep_nrsfm_ros import __version__
from deep_nrsfm_ros.configuration import check
from deep_nrsfm_ros.nrsfm.correction import error_covariance
from deep_nrsfm_ros.nrsfm.geometry import Floats
from deep_nrsfm_ros.nrsfm.keypoints import KeypointLayout
from deep_nrsfm_ros.nrsfm.losses import Frames, Objective, visible_centre
from deep_nrsfm_ros.nrsfm.metrics import object_frame
from deep_nrsfm_ros.nrsfm.model_file import Model
from deep_nrsfm_ros.nrsfm.network import (
    Network,
    coherence,
    complete,
    initialise,
    reconstruct,
    whitening,
)
from deep_nrsfm_ros.nrsfm.normaliser import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import Preset, Recipe


class Progress(NamedTuple):
    """State of a training, means over the steps since the last report."""

    step: int
    steps: int
    seed: int
    loss: float  # relative reprojection error
    cycle_error: float  # relative error of shapes reconstructed again from another camera
    coherence: float  # of the final dictionary
    seconds_left: float


class Trainer:
    """One initialisation in training: network, optimiser and step, all of it resumable.

    The randomness of a step depends on the seed and the step alone, so a training resumed from a
    checkpoint goes on exactly as if it had not stopped.
    """

    def __init__(
        self, frames: Frames, preset: Preset, seed: int, start: Network | None = None
    ) -> None:
        """Initialise the network from `seed`, or take that of `start`.

        Either is whitened by the frames, unless it has a whitening already.
        """
        architecture, normaliser, recipe = preset
        self.frames, self.preset, self.seed, self.step = frames, preset, seed, 0
        self.cpu_seconds = 0.0
        device = frames.points.device
        initial = start or initialise(
            architecture,
            frames.points.shape[1],
            np.random.default_rng(seed),
            as_released=recipe.as_released,
        )
        if architecture.whitening and np.array_equal(initial.L, np.eye(initial.p)):
            moment = second_moment(frames, normaliser)
            exponent, floor = architecture.whitening, architecture.whitening_floor
            L, L_inverse = whitening(moment, exponent, floor)
            initial = dataclasses.replace(initial, L=L, L_inverse=L_inverse)
        self.initial = initial.map(lambda w: torch.from_numpy(w).to(device))
        # All weights in one tensor: Adam costs a tenth of a step on one, a fifth on fifty.
        self.weights = torch.cat([w.flatten() for _, w in self.initial.learned()]).requires_grad_()
        self.optimiser = torch.optim.Adam([self.weights], lr=recipe.learning_rate, fused=True)
        self.objective = Objective(normaliser, recipe)
        plain = dataclasses.replace(recipe, noise=0.0, mask=0.0, cycle=1.0)
        self.plain_objective = Objective(normaliser, plain, whitened=False)
        self.generator = torch.Generator(device)
        self.shapes: Tensor | None = None  # of the last batch, for the cycle loss
        self.probe = self.sample(1024)

    @property
    def net(self) -> Network:
        """Return the network as it is; what is learned in it are views of `weights`."""
        learned = dict(self.initial.learned())
        parts = torch.split(self.weights, [w.numel() for w in learned.values()])
        views = (part.view(w.shape) for part, w in zip(parts, learned.values(), strict=True))
        weights = dict(self.initial.named()) | dict(zip(learned, views, strict=True))
        return Network.from_named(self.initial.architecture, weights)

    def sample(self, size: int, step: int = -1) -> Frames:
        """Return the random batch of a step; leaves the generator ready for its cameras."""
        self.generator.manual_seed((self.seed << 32) + step + 1)
        f = len(self.frames.points)
        device = self.frames.points.device
        chosen = torch.randint(f, (size,), generator=self.generator, device=device)
        return Frames(self.frames.points[chosen], self.frames.mask[chosen])

    def advance(self) -> None:
        """Take one gradient step."""
        began = time.process_time()
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(self.preset.recipe, self.step)
        batch = self.sample(self.preset.recipe.batch, self.step)
        losses = self.objective(self.net, batch, self.shapes, self.generator)
        self.shapes = losses.shapes
        self.optimiser.zero_grad(set_to_none=True)
        losses.total.backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()
        self.step += 1
        self.cpu_seconds += time.process_time() - began

    @torch.no_grad()
    def measure(self) -> tuple[float, float]:
        """Return (reprojection error, cycle error) on fixed frames without augmentation."""
        self.generator.manual_seed(self.seed)
        shapes = self.plain_objective(self.net, self.probe, None, self.generator).shapes
        losses = self.plain_objective(self.net, self.probe, shapes, self.generator)
        return float(losses.reprojection), float(losses.cycle)

    def state(self) -> dict[str, Tensor]:
        """Return everything that `restore` needs, as named tensors."""
        tensors = {name: torch.tensor(getattr(self, name)) for name in _COUNTS}
        tensors |= {"weights": self.weights.detach(), "L": self.initial.L}
        if self.shapes is not None:
            tensors["shapes"] = self.shapes
        moments = self.optimiser.state.get(self.weights, {})
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
        self.optimiser.state[self.weights] = {
            name.removeprefix("adam."): value.to(device)
            for name, value in tensors.items()
            if name.startswith("adam.")
        }
        self.probe = self.sample(1024)


_COVARIANCE_FRAMES = 2048
_COUNTS = {"step", "seed", "cpu_seconds"}


def second_moment(frames: Frames, normaliser: Normaliser) -> NDArray[np.float64]:
    """Return E[W W^T] (p, p), each entry over the frames in which both points are visible."""
    total = seen = torch.zeros(())
    for start in range(0, len(frames.points), 16384):
        points, mask = (tensor[start : start + 16384] for tensor in frames)
        W = normaliser.encode(points, mask).W.double()
        total = total + (W @ W.swapaxes(-1, -2)).sum(0)
        seen = seen + (mask @ mask.swapaxes(-1, -2)).double().sum(0)
    moment = (total / seen.clamp(min=1)).cpu().numpy()
    return np.asarray(moment, np.float64)


def learning_rate(recipe: Recipe, step: int) -> float:
    """Return the learning rate of a step by the recipe's schedule."""
    if recipe.schedule == "exponential":
        return recipe.learning_rate * float(0.95 ** (step / 10000))
    return recipe.learning_rate * 0.5 * (1 + math.cos(math.pi * step / recipe.steps))


def train(
    points: NDArray[np.float32],
    visible: NDArray[np.bool_],
    preset: Preset,
    *,
    on_step: Callable[[Trainer], None] = lambda trainer: None,
    on_progress: Callable[[Progress], None] = lambda progress: None,
    should_stop: Callable[[], bool] = lambda: False,
    checkpoint: Path | None = None,
    checkpoint_seconds: float = 30.0,
    start: Network | None = None,
) -> Trainer:
    """Train on keypoints (f, p, 2) with visibility (f, p), any unit, x right and y down.

    Returns the trainer at its last step, earlier if `should_stop`. With `checkpoint`, goes on
    from that file if it exists and writes it every `checkpoint_seconds` and when it stops early.
    `start` is the network to begin with instead of a random one (see `fine_tuning`), of the
    preset's architecture; there are no seeds to choose from then. `on_step` sees the trainer when
    its seed is chosen and after each step from then on; `on_progress` hears of all steps now and
    then. Raises ValueError for data that cannot be trained on or a checkpoint that does not fit.
    """
    for config in preset:
        check(config)
    recipe = preset.recipe
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    frames = Frames(*(tensor.to(device) for tensor in _usable(points, visible)))
    clock = _Clock(recipe)

    def run(trainer: Trainer, until: int, on_step: Callable[[Trainer], None]) -> Trainer:
        clock.restart(trainer.step)
        on_step(trainer)
        while trainer.step < until and not should_stop():
            trainer.advance()
            on_step(trainer)
            if clock.due():
                on_progress(clock.progress(trainer))
        return trainer

    def chosen() -> Trainer:
        """Return the seed with the lowest cycle error after a short training.

        A half-mirrored solution shows a high one soon, whatever its loss.
        """
        first, until = recipe.seed * recipe.seeds, min(recipe.screening, recipe.steps // 10)
        candidates = (
            run(Trainer(frames, preset, first + i), until, lambda trainer: None)
            for i in range(recipe.seeds)
        )
        return min(candidates, key=lambda trainer: trainer.measure()[1])

    saved = time.monotonic()

    def save_and_show(trainer: Trainer) -> None:
        nonlocal saved
        on_step(trainer)
        if checkpoint is not None and time.monotonic() - saved > checkpoint_seconds:
            write_checkpoint(checkpoint, trainer)
            saved = time.monotonic()

    if checkpoint is not None and checkpoint.exists():
        trainer = Trainer(frames, preset, recipe.seed, start)
        trainer.restore(read_checkpoint(checkpoint))
    elif recipe.seeds == 1 or start is not None:
        trainer = Trainer(frames, preset, recipe.seed, start)
    else:
        trainer = chosen()
        if should_stop():  # no checkpoint: going on from here would skip seeds
            checkpoint = None
    run(trainer, recipe.steps, save_and_show)
    if checkpoint is not None and trainer.step < recipe.steps:
        write_checkpoint(checkpoint, trainer)
    on_progress(clock.progress(trainer))
    return trainer


def _usable(points: NDArray[np.float32], visible: NDArray[np.bool_]) -> Frames:
    """Return the frames that have an extent; raise ValueError if there are none.

    The error of a frame is relative to its extent: a few without one would drown all others.
    """
    mask = torch.from_numpy(visible[..., None].astype(np.float32))
    tensor = torch.from_numpy(np.where(visible[..., None], points, np.float32(0)))
    extent = visible_centre(tensor, mask).norm(dim=(-2, -1)).numpy()
    usable = torch.from_numpy(extent > 1e-4 * extent.max(initial=0))
    if not usable.any():
        raise ValueError(f"none of the {len(points)} frames shows two keypoints apart")
    return Frames(tensor[usable], mask[usable])


class _Clock:
    """When to report, and how long is left."""

    def __init__(self, recipe: Recipe, every_seconds: float = 5.0) -> None:
        self.steps, self.every = recipe.steps, every_seconds
        self.restart(0)

    def restart(self, step: int) -> None:
        self.began = self.reported = time.monotonic()
        self.first = step

    def due(self) -> bool:
        return time.monotonic() - self.reported >= self.every

    def progress(self, trainer: Trainer) -> Progress:
        self.reported = time.monotonic()
        pace = (self.reported - self.began) / max(trainer.step - self.first, 1)
        loss, cycle = trainer.measure()
        sharpness = coherence(trainer.net.map(lambda w: w.detach().cpu().numpy()))
        left = pace * (self.steps - trainer.step)
        return Progress(trainer.step, self.steps, trainer.seed, loss, cycle, sharpness, left)


def write_checkpoint(path: Path, trainer: Trainer) -> None:
    """Write the trainer's state whole or not at all."""
    partial = path.with_name(f"{path.name}.partial")
    save_file({k: t.contiguous().cpu() for k, t in trainer.state().items()}, partial)
    os.replace(partial, path)


def read_checkpoint(path: Path) -> dict[str, Tensor]:
    """Return a saved state; raise ValueError if the file is damaged."""
    try:
        return load_file(path)
    except (OSError, SafetensorError) as error:
        raise ValueError(f"checkpoint {path} cannot be read ({error}); delete it") from error


def finish(trainer: Trainer, name: str, layout: KeypointLayout, source: str) -> Model:
    """Return the trained model with its object frame, provenance and label-free quality."""
    loss, cycle = trainer.measure()
    net = trainer.net.map(lambda w: w.detach().cpu().numpy())
    normaliser = trainer.preset.normaliser

    def lift(W: Floats) -> tuple[Floats, Floats, Floats]:
        seen = normaliser.encode(W, np.ones_like(W[..., :1]))
        return *reconstruct(net, seen.W), seen.W

    sample = trainer.sample(min(_COVARIANCE_FRAMES, 4 * len(trainer.frames.points)))
    W, _ = complete(net, sample.points.cpu().numpy(), sample.mask.cpu().numpy())
    S, _, _ = lift(W)
    covariance = error_covariance(lift, W, np.random.default_rng(trainer.seed))
    return Model(
        name,
        net,
        layout,
        normaliser,
        object_frame(S, layout),
        error_covariance=covariance,
        provenance={
            "data": source,
            "frames": len(trainer.frames.points),
            "recipe": dataclasses.asdict(trainer.preset.recipe),
            "seed": trainer.seed,
            "step": trainer.step,
            "cpu_seconds": round(trainer.cpu_seconds, 2),
            "versions": {"deep_nrsfm_ros": __version__, "torch": torch.__version__},
        },
        quality={
            "reprojection_error": round(loss, 5),
            "cycle_error": round(cycle, 5),
            "combined": round(math.hypot(loss, cycle), 5),
            "coherence": round(coherence(net), 5),
        },
    )
