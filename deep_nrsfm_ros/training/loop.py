# SPDX-License-Identifier: Apache-2.0
"""The training loop: short trainings of several seeds, the best of them trained to the end.

Learns from 2D keypoints alone. `finish` makes a model of the trainer that the loop returns.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deep_nrsfm_ros.configuration import check
from deep_nrsfm_ros.nrsfm.factorisation.consensus import Consensus
from deep_nrsfm_ros.nrsfm.geometry import centre_visible
from deep_nrsfm_ros.nrsfm.recipe import Preset
from deep_nrsfm_ros.training.best_checkpoint import BestCheckpoint
from deep_nrsfm_ros.training.checkpoint import read_checkpoint, write_checkpoint
from deep_nrsfm_ros.training.early_stopping import end_reason, time_is_up
from deep_nrsfm_ros.training.few_frames import TIME_SHARE, Factorised, FactorisedShapes, factorise
from deep_nrsfm_ros.training.fine_tuning import lacks_whitening
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.limb_exchange import with_limb_exchange
from deep_nrsfm_ros.training.mirror import TOLERATED, KnownShapesSource, MirrorCheck, most_frames
from deep_nrsfm_ros.training.progress import Clock, Progress
from deep_nrsfm_ros.training.setup import DEFAULT_SETUP, Setup
from deep_nrsfm_ros.training.steps import with_steps
from deep_nrsfm_ros.training.trainer import Trainer
from deep_nrsfm_ros.wording import wording

_SCREENING_SHARE = 0.1  # of the time, at most
_FACTORISED = "factorised."  # begins the names of checkpoints' tensors of factorised shapes
_SMALLEST_EXTENT = 1e-4  # of the largest one; a frame of less has no extent
_ROUNDING = 1e-5  # of the largest coordinate of a frame; an extent of less is that of float32


@dataclass(frozen=True)
class Callbacks:
    """Functions that a training calls on its way.

    Attributes:
        on_step: called with the trainer when its seed is chosen, and after each step from then on.
        on_progress: called every few seconds, and at the end, by the first process.
        should_stop: called before each step (every 16 steps in a group of processes); True ends
            the training.
        on_message: called with a sentence when work of up to minutes begins before the first step,
            and with the step at which a training goes on.
    """

    on_step: Callable[[Trainer], None] = lambda trainer: None
    on_progress: Callable[[Progress], None] = lambda progress: None
    should_stop: Callable[[], bool] = lambda: False
    on_message: Callable[[str], None] = lambda sentence: None


@dataclass(frozen=True)
class Checkpointing:
    """Where and how often a training saves its state.

    Attributes:
        file: written every `seconds` and when the training is stopped; a training whose file
            exists continues from it. None saves nothing.
        seconds: wall time from one checkpoint to the next.
    """

    file: Path | None = None
    seconds: float = 30.0


NO_CALLBACKS, NO_CHECKPOINTS = Callbacks(), Checkpointing()


def train(
    points: NDArray[np.float32],
    visible: NDArray[np.bool_],
    preset: Preset,
    setup: Setup = DEFAULT_SETUP,
    callbacks: Callbacks = NO_CALLBACKS,
    checkpointing: Checkpointing = NO_CHECKPOINTS,
) -> Trainer:
    """Train a network on 2D keypoints and return its trainer.

    The same seed gives the same network, unless `setup.limits.minutes` is set: the learning rate
    follows the clock then. The minutes count from this call, plus those of a checkpoint that the
    training continues from. All processes of `setup.group` call this function with the same
    arguments, all frames included, and each trains on its own part of the frames, or with frames
    of its own (`setup.own_frames`); only the first one reports progress and uses the checkpoint.

    Args:
        points: (f, p, 2) keypoints in any unit, x right and y down. They are not copied: do not
            change them while the training runs.
        visible: (f, p), True where a point was detected.
        preset: architecture, normaliser and recipe.
        setup: start, layout loss, limits and processes.
        callbacks: functions to call on the way.
        checkpointing: where to save the state and to continue from.

    Returns:
        The trainer at its last step, or at its best one if `setup.limits.keep_best`. Its
        `end_reason` says why the training is complete, and is "" where `should_stop` ended it. A
        training that was stopped while seeds were screened returns the best seed so far.

    Raises:
        ValueError: for options out of range, for data without two points apart, for exchanged
            limbs of a layout that has none, or for a checkpoint that is damaged or belongs to
            another training.
    """
    for config in (*preset, setup.limits):
        check(config)
    if not preset.recipe.steps and setup.start is None:
        raise ValueError("steps is 0 and there is no network to start from; it must be at least 1")
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    frames, group = _frames_with_extent(points, visible), setup.group
    count = torch.tensor(len(frames))
    if setup.own_frames:
        group.sum_in_place(count)
    recipe = with_steps(preset.recipe, int(count), setup.start)
    recipe = with_limb_exchange(recipe, setup.start, setup.limb_exchange)
    preset = preset._replace(recipe=recipe)
    if group.size > min(len(frames) * (group.size if setup.own_frames else 1), preset.recipe.batch):
        raise ValueError(
            f"{group.size} processes are more than the {len(frames)} frames or the batch of "
            f"{preset.recipe.batch} can be shared out to"
        )
    usable = frames.usable if setup.own_frames else group.shard(frames.usable)
    part = dataclasses.replace(frames, usable=usable).to(device)
    if group.rank:
        checkpointing = dataclasses.replace(checkpointing, file=None)
    file = checkpointing.file
    saved = group.broadcast(read_checkpoint(file) if file is not None and file.exists() else None)
    return _Loop(part, preset, setup, callbacks, checkpointing, saved).train()


def _tensors_of(factorised: Factorised) -> dict[str, Tensor]:
    """Return what factorisations found as named tensors of a checkpoint."""
    tensors = {_FACTORISED + "minutes_needed": torch.tensor(factorised.minutes_needed)}
    if factorised.shapes is not None:
        for name, value in factorised.shapes._asdict().items():
            tensors[_FACTORISED + name] = torch.as_tensor(value)
    return tensors


def _saved_factorisation(saved: dict[str, Tensor]) -> Factorised:
    """Return what factorisations had found when a checkpoint was written."""
    of = {
        name.removeprefix(_FACTORISED): tensor
        for name, tensor in saved.items()
        if name.startswith(_FACTORISED)
    }
    minutes_needed = float(of.pop("minutes_needed", 0.0))
    if not of:
        return Factorised(None, minutes_needed)
    shapes, rotations, scales = (of[name].numpy() for name in ("shapes", "rotations", "scales"))
    spread, solutions = float(of["spread"]), int(of["solutions"])
    return Factorised(Consensus(shapes, rotations, scales, spread, solutions), minutes_needed)


class _Loop:
    """One call of `train`: the trainer and, while seeds are screened, the best one so far.

    A checkpoint holds all of it: the states of both trainers, the best weights and the seconds
    that the training has taken.
    """

    def __init__(
        self,
        frames: FrameStore,
        preset: Preset,
        setup: Setup,
        callbacks: Callbacks,
        checkpointing: Checkpointing,
        saved: dict[str, Tensor] | None = None,
    ) -> None:
        """Begin a training, or continue the one of the tensors that were saved.

        Raises:
            ValueError: the tensors belong to another training.
        """
        recipe = preset.recipe
        self.frames, self.preset, self.setup = frames, preset, setup
        self.callbacks, self.checkpointing, self.group = callbacks, checkpointing, setup.group
        self.clock = Clock(recipe.steps, setup.limits.minutes * 60)
        self.factorised = self._factorisation(saved)
        factorisation = self.factorised.shapes
        # Seeds differ in which frames they mirror; factorised shapes leave them no choice.
        self.screening = recipe.seeds > 1 and setup.start is None and factorisation is None
        self.first_seed = recipe.seed * (recipe.seeds if self.screening else 1)
        self.trainer = self._trainer(self.first_seed)
        self.leader: Trainer | None = None
        self.leader_error = math.inf
        self.best = BestCheckpoint(setup.limits, recipe)
        self.mirror = MirrorCheck(frames, preset.normaliser, most_frames(recipe), self.group)
        taught = None if factorisation is None else FactorisedShapes(factorisation)
        self.known_shapes = KnownShapesSource(self.mirror, recipe, taught)
        # Factorised shapes took long: they are saved with the first step.
        self.saved = time.monotonic() if factorisation is None else -math.inf
        self.stopped, self.time_fraction = False, 0.0
        self.iterations = 0  # of this process, over all seeds
        if saved is not None:
            self._restore(saved)

    def _factorisation(self, saved: dict[str, Tensor] | None) -> Factorised:
        """Return the shapes that few frames teach, if any; the clock counts the time they take.

        A training that continues has those of its checkpoint.
        """
        if saved is not None:
            return _saved_factorisation(saved)
        if self.setup.start is not None or self.group.size > 1:
            return Factorised()
        calls, limit = self.callbacks, self.clock.limit
        most_seconds = TIME_SHARE * limit if limit else math.inf
        found = factorise(
            self.frames, self.preset, calls.should_stop, calls.on_message, most_seconds
        )
        self.clock.begin_steps()
        return found

    def train(self) -> Trainer:
        """Train to the end, or until the callbacks or the limits end it; return the trainer."""
        if self.screening:
            self._screen()
        if not self.stopped:
            self._advance(self.preset.recipe.steps, 1.0, chosen=True)
        trainer = self.trainer
        if self.stopped:
            if self.checkpointing.file is not None and (trainer.step or self.leader):
                write_checkpoint(self.checkpointing.file, self.state())
            trainer = self.leader or trainer
        else:
            trainer.end_reason = end_reason(
                all_steps=trainer.step == self.preset.recipe.steps,
                no_improvement=self.best.patience_exceeded,
            )
        self.best.restore_best(trainer)
        if not self.group.rank:
            self.callbacks.on_progress(self.clock.progress(trainer, self.iterations))
        share, start = self.preset.recipe.start_share, self.setup.start
        if trainer.step and share and start is not None and not lacks_whitening(start):
            before = math.hypot(*trainer.measure())
            trainer.average_with_start(share)
            after = math.hypot(*trainer.measure())
            if not self.group.rank:
                self.callbacks.on_message(_mean_in_words(share, before, after))
        if trainer.end_reason:
            trainer.mirrored_share = self.mirror.share(trainer.net)
        return trainer

    def _screen(self) -> None:
        """Choose the seed with the lowest sum of cycle error and share of mirrored frames.

        Both are measured after a short training. A seed that mirrors no frame goes on at once: its
        rivals could only be better by a chance that the rest of the training levels.
        """
        recipe = self.preset.recipe
        steps = min(recipe.screening, recipe.steps // 10)
        for done in range(self.trainer.seed - self.first_seed + 1, recipe.seeds + 1):
            self._advance(steps, _SCREENING_SHARE * done / recipe.seeds)
            if self.stopped:
                return
            _, error = self.group.mean(self.trainer.measure())
            mirrored = self.mirror.share(self.trainer.net)
            error += 0.0 if math.isnan(mirrored) else mirrored
            if self.leader is None or error < self.leader_error:
                self.leader, self.leader_error = self.trainer, error
            if mirrored <= TOLERATED:
                break
            if done < recipe.seeds:
                self.trainer = self._trainer(self.first_seed + done)
        assert self.leader is not None
        self.trainer, self.leader, self.screening = self.leader, None, False

    def _trainer(self, seed: int) -> Trainer:
        """Return a new trainer of a seed."""
        trainer = Trainer(self.frames, self.preset, seed, self.setup, self.factorised.shapes)
        trainer.minutes_needed = self.factorised.minutes_needed
        return trainer

    def _advance(self, steps: int, time_budget: float, *, chosen: bool = False) -> None:
        """Train up to step `steps`, or until `time_budget` of the time limit has elapsed.

        `chosen`: the seed is chosen; calls `on_step` and looks for the best state.
        """
        trainer, best = self.trainer, self.best if chosen else None
        if chosen:
            self.callbacks.on_step(trainer)
        while trainer.step < steps and not (best and best.patience_exceeded):
            if self.iterations % self.group.stop_interval == 0:
                wishes = self.callbacks.should_stop(), self.clock.elapsed_fraction()
                self.stopped, self.time_fraction = self.group.any_stop(*wishes)
            self.iterations += 1
            trainer.time_fraction = self.time_fraction
            if self.stopped or time_is_up(trainer.step, trainer.time_fraction, time_budget):
                return
            if chosen:
                self.known_shapes.prepare(trainer)
            trainer.advance()
            if best:
                best.update(trainer)
                self.callbacks.on_step(trainer)
            self._save_if_due()
            if not self.group.rank and self.clock.due():
                self.callbacks.on_progress(self.clock.progress(trainer, self.iterations))

    def _save_if_due(self) -> None:
        """Write a checkpoint if the last one is old enough."""
        file, seconds = self.checkpointing.file, self.checkpointing.seconds
        if file is None or time.monotonic() - self.saved <= seconds:
            return
        write_checkpoint(file, self.state())
        self.saved = time.monotonic()

    def state(self) -> dict[str, Tensor]:
        """Return all that a training needs to continue, as named tensors."""
        tensors = self.trainer.state() | self.best.state() | self.known_shapes.state()
        tensors["seconds"] = torch.tensor(self.clock.seconds(), dtype=torch.float64)
        tensors |= _tensors_of(self.factorised)
        if self.screening:
            tensors["screening"] = torch.tensor(self.leader_error, dtype=torch.float64)
        if self.leader:
            leader = self.leader.state()
            tensors |= {f"leader.{name}": tensor for name, tensor in leader.items()}
        return tensors

    def _restore(self, tensors: dict[str, Tensor]) -> None:
        """Continue from a `state`; raise ValueError if it belongs to another training."""
        self.trainer.restore(tensors)
        self.best.restore(tensors)
        self.known_shapes.restore(tensors)
        self.clock.earlier_seconds += float(tensors.get("seconds", 0.0))
        last_seed = self.first_seed + self.preset.recipe.seeds - 1
        if "screening" not in tensors:
            self.screening = False
        elif not self.screening or not self.first_seed <= self.trainer.seed <= last_seed:
            raise ValueError("the checkpoint is of a training that screens other seeds; delete it")
        leader = {
            name.removeprefix("leader."): tensor
            for name, tensor in tensors.items()
            if name.startswith("leader.")
        }
        if self.screening and leader:
            self.leader = self._trainer(self.first_seed)
            self.leader.restore(leader)
            self.leader_error = float(tensors["screening"])
        where = f"step {self.trainer.step} of {self.preset.recipe.steps}"
        if self.screening:
            where += f", where seed {self.trainer.seed} is screened"
        self.callbacks.on_message(f"goes on at {where}")


def _mean_in_words(share: float, before: float, after: float) -> str:
    """Return a sentence on the mean with the start, and the combined error before and after it."""
    option = wording(
        "--start-share, train.start_share", node="train.start_share", python="Recipe.start_share"
    )
    return (
        f"the model is the mean of its start, with a share of {share:g} ({option}), and of the "
        f"trained weights: combined is {after:.3f} on the frames of the training, and was "
        f"{before:.3f} before; the mean keeps what the start can do on other frames"
    )


def _frames_with_extent(points: NDArray[np.float32], visible: NDArray[np.bool_]) -> FrameStore:
    """Return the frames whose visible points lie apart; raise ValueError if there are none.

    The error of a frame is relative to its extent, so frames without one would dominate the loss.
    """
    frames = FrameStore.of(points, visible)
    extent, done = np.zeros(len(frames), np.float32), 0
    for block, mask in frames.batches():
        norms = centre_visible(block, mask).norm(dim=(-2, -1))
        rounding = _ROUNDING * (block * mask).abs().amax(dim=(-2, -1))
        extent[done : done + len(norms)] = torch.where(norms > rounding, norms, 0.0).numpy()
        done += len(norms)
    usable = torch.from_numpy(extent > _SMALLEST_EXTENT * extent.max(initial=0))
    if not usable.any():
        raise ValueError(f"none of the {len(points)} frames shows two keypoints apart")
    return dataclasses.replace(frames, usable=frames.usable[usable])
