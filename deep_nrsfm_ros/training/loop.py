"""Training: seeds screened, the best trained on, from 2D keypoints alone."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deep_nrsfm_ros import __version__
from deep_nrsfm_ros.configuration import check
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.correction import bone_lengths, error_covariance
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.geometry import Floats
from deep_nrsfm_ros.nrsfm.handedness import object_frame
from deep_nrsfm_ros.nrsfm.layout_loss import LayoutLoss
from deep_nrsfm_ros.nrsfm.losses import visible_centre
from deep_nrsfm_ros.nrsfm.network import Network, coherence, complete, reconstruct
from deep_nrsfm_ros.nrsfm.recipe import Preset
from deep_nrsfm_ros.training.best_checkpoint import BestCheckpoint
from deep_nrsfm_ros.training.checkpoint import read_checkpoint, write_checkpoint
from deep_nrsfm_ros.training.distributed import ALONE, ProcessGroup
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.limits import WHOLE, Limits
from deep_nrsfm_ros.training.progress import Clock, Progress
from deep_nrsfm_ros.training.trainer import Trainer

_COVARIANCE_FRAMES = 2048
_SCREENING_SHARE = 0.1  # of the time, at most


def train(
    points: NDArray[np.float32],
    visible: NDArray[np.bool_],
    preset: Preset,
    *,
    limits: Limits = WHOLE,
    on_step: Callable[[Trainer], None] = lambda trainer: None,
    on_progress: Callable[[Progress], None] = lambda progress: None,
    should_stop: Callable[[], bool] = lambda: False,
    checkpoint: Path | None = None,
    checkpoint_seconds: float = 30.0,
    start: Network | None = None,
    team: ProcessGroup = ALONE,
    layout_loss: LayoutLoss | None = None,
) -> Trainer:
    """Train on keypoints (f, p, 2) with visibility (f, p), any unit, x right and y down.

    They are not copied: whoever changes them meanwhile changes what is learned from.
    Returns the trainer at its last step, or at its best one if `limits` say so; its `ended` says
    why there is nothing left to be done, and is "" after `should_stop`. With `limits.minutes`,
    which count from this call on and over all that is gone on with, the same seed does not give
    the same model twice. With `checkpoint`, goes on from that file if it exists and writes it
    every `checkpoint_seconds` and when it is stopped; what is stopped while the seeds are
    screened goes on there too, and returns the best seed so far. `start` is the network to begin
    with instead of a random one (see `fine_tuning`), of the preset's architecture; there are no
    seeds to choose from then. `on_step` sees the trainer when its seed is chosen and after each
    step from then on; `on_progress` hears of all steps now and then. Every process of a `team`
    calls this with the same arguments, all frames included, and keeps its shard; the first alone
    calls `on_progress` and uses the checkpoint. `layout_loss` is what the layout knows of the
    object, a loss besides the preset's. Raises ValueError for data that cannot be trained
    on or a checkpoint that does not fit.
    """
    for config in (*preset, limits):
        check(config)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    usable = _usable(points, visible)
    if team.size > min(len(usable), preset.recipe.batch):
        raise ValueError(
            f"{team.size} processes are more than the {len(usable)} frames or the batch of "
            f"{preset.recipe.batch} can be shared out to"
        )
    frames = dataclasses.replace(usable, usable=team.shard(usable.usable)).to(device)
    run = _Run(frames, preset, limits, start, team, layout_loss)
    run.on_progress, run.should_stop = on_progress, should_stop
    run.checkpoint, run.checkpoint_seconds = checkpoint, checkpoint_seconds
    if team.rank:
        run.checkpoint = None
    file = run.checkpoint
    saved = team.tell(read_checkpoint(file) if file is not None and file.exists() else None)
    if saved is not None:
        run.restore(saved)
    return run.train(on_step)


class _Run:
    """One call of `train`: the trainer in training and, while seeds are screened, the best one.

    All of it is in a checkpoint: the state of the trainer, of the leader, the best weights and
    the seconds that are gone.
    """

    on_progress: Callable[[Progress], None]
    should_stop: Callable[[], bool]
    checkpoint: Path | None
    checkpoint_seconds: float

    def __init__(
        self,
        frames: FrameStore,
        preset: Preset,
        limits: Limits,
        start: Network | None,
        team: ProcessGroup,
        layout_loss: LayoutLoss | None,
    ) -> None:
        recipe = preset.recipe
        self.frames, self.preset, self.team, self.layout_loss = frames, preset, team, layout_loss
        self.screening = recipe.seeds > 1 and start is None
        self.first_seed = recipe.seed * (recipe.seeds if self.screening else 1)
        self.trainer = Trainer(frames, preset, self.first_seed, start, team, layout_loss)
        self.leader: Trainer | None = None
        self.leader_error = math.inf
        self.best = BestCheckpoint(limits, recipe)
        self.clock = Clock(recipe.steps, limits.minutes * 60)
        self.saved = time.monotonic()
        self.stopped, self.time_gone = False, 0.0
        self.asked = 0

    def train(self, on_step: Callable[[Trainer], None]) -> Trainer:
        if self.screening:
            self._screen()
        if not self.stopped:
            self._take(self.preset.recipe.steps, 1.0, on_step, self.best)
        trainer = self.trainer
        if self.stopped:
            if self.checkpoint is not None and (trainer.step or self.leader):
                write_checkpoint(self.checkpoint, self.state())
            trainer = self.leader or trainer
        elif self.best.standstill:
            trainer.ended = "its quality no longer improved"
        else:
            finished = trainer.step == self.preset.recipe.steps
            trainer.ended = "all steps were taken" if finished else "its time was up"
        self.best.put_back(trainer)
        if not self.team.rank:
            self.on_progress(self.clock.progress(trainer))
        return trainer

    def _screen(self) -> None:
        """Choose the seed with the lowest cycle error after a short training.

        A half-mirrored solution shows a high one soon, whatever its loss.
        """
        recipe = self.preset.recipe
        until = min(recipe.screening, recipe.steps // 10)
        for done in range(self.trainer.seed - self.first_seed + 1, recipe.seeds + 1):
            self._take(until, _SCREENING_SHARE * done / recipe.seeds)
            if self.stopped:
                return
            _, error = self.team.mean(self.trainer.measure())
            if self.leader is None or error < self.leader_error:
                self.leader, self.leader_error = self.trainer, error
            if done < recipe.seeds:
                self.trainer = self._fresh(self.first_seed + done)
        assert self.leader is not None
        self.trainer, self.leader, self.screening = self.leader, None, False

    def _fresh(self, seed: int) -> Trainer:
        return Trainer(self.frames, self.preset, seed, None, self.team, self.layout_loss)

    def _take(
        self,
        steps: int,
        time_share: float,
        on_step: Callable[[Trainer], None] = lambda trainer: None,
        best: BestCheckpoint | None = None,
    ) -> None:
        """Train on to so many steps, or until that share of the time is gone.

        One step is taken in any case, so that there is something to compare or to keep.
        """
        trainer = self.trainer
        self.clock.restart(trainer.step)
        on_step(trainer)
        while trainer.step < steps and not (best and best.standstill):
            if self.asked % self.team.settle_every == 0:
                said = self.should_stop(), self.clock.gone()
                self.stopped, self.time_gone = self.team.agree(*said)
            self.asked += 1
            trainer.time_gone = self.time_gone
            if self.stopped or (trainer.step and trainer.time_gone >= time_share):
                return
            trainer.advance()
            if best:
                best.look(trainer)
            on_step(trainer)
            self._save_now_and_then()
            if not self.team.rank and self.clock.due():
                self.on_progress(self.clock.progress(trainer))

    def _save_now_and_then(self) -> None:
        if self.checkpoint is None or time.monotonic() - self.saved <= self.checkpoint_seconds:
            return
        write_checkpoint(self.checkpoint, self.state())
        self.saved = time.monotonic()

    def state(self) -> dict[str, Tensor]:
        """Return everything that `restore` needs, as named tensors."""
        tensors = self.trainer.state() | self.best.state()
        tensors["seconds"] = torch.tensor(self.clock.seconds(), dtype=torch.float64)
        if self.screening:
            tensors["screening"] = torch.tensor(self.leader_error, dtype=torch.float64)
        if self.leader:
            leader = self.leader.state()
            tensors |= {f"leader.{name}": tensor for name, tensor in leader.items()}
        return tensors

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Take over a `state`; raise ValueError if it is not of such a training."""
        self.trainer.restore(tensors)
        self.best.restore(tensors)
        self.clock.before = float(tensors.get("seconds", 0.0))
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
            self.leader = self._fresh(self.first_seed)
            self.leader.restore(leader)
            self.leader_error = float(tensors["screening"])


def _usable(points: NDArray[np.float32], visible: NDArray[np.bool_]) -> FrameStore:
    """Return the frames that have an extent; raise ValueError if there are none.

    The error of a frame is relative to its extent: a few without one would drown all others.
    """
    pool = FrameStore.of(points, visible)
    extent, done = np.zeros(len(pool), np.float32), 0
    for block in pool.blocks():
        found = visible_centre(*block).norm(dim=(-2, -1))
        extent[done : done + len(found)] = found.numpy()
        done += len(found)
    usable = torch.from_numpy(extent > 1e-4 * extent.max(initial=0))
    if not usable.any():
        raise ValueError(f"none of the {len(points)} frames shows two keypoints apart")
    return dataclasses.replace(pool, usable=pool.usable[usable])


def finish(trainer: Trainer, name: str, layout: KeypointLayout, source: str) -> Model:
    """Return the trained model with its object frame, provenance and label-free quality."""
    loss, cycle = trainer.measure()
    layout_loss = trainer.objective.layout_loss
    net = trainer.net.map(lambda w: w.cpu().numpy())
    normaliser = trainer.preset.normaliser

    def lift(W: Floats) -> tuple[Floats, Floats, Floats]:
        seen = normaliser.encode(W, np.ones_like(W[..., :1]))
        return *reconstruct(net, seen.W), seen.W

    sample = trainer.sample(min(_COVARIANCE_FRAMES, 4 * len(trainer.frames)))
    mask = sample.mask.cpu().numpy()
    W, _ = complete(net, sample.points.cpu().numpy(), mask)
    S, _, _ = lift(W)
    rng = np.random.default_rng(trainer.seed)
    covariance = error_covariance(lift, W, rng)
    return Model(
        name,
        net,
        layout,
        normaliser,
        object_frame(S, layout, mask[..., 0] > 0),
        error_covariance=covariance,
        bone_lengths=bone_lengths(lift, W, layout.bone_indices(), covariance, rng),
        provenance={
            "data": source,
            "frames": trainer.frames_in_all,
            "recipe": dataclasses.asdict(trainer.preset.recipe),
            **(
                {}
                if layout_loss is None
                else {"layout_loss": dataclasses.asdict(layout_loss.weights)}
            ),
            "seed": trainer.seed,
            "step": trainer.step,
            **({} if trainer.kept is None else {"kept_step": trainer.kept}),
            "cpu_seconds": round(trainer.cpu_seconds, 2),  # of the first process
            **({} if trainer.team.size == 1 else {"processes": trainer.team.size}),
            "versions": {"deep_nrsfm_ros": __version__, "torch": torch.__version__},
        },
        quality={
            "reprojection_error": round(loss, 5),
            "cycle_error": round(cycle, 5),
            "combined": round(math.hypot(loss, cycle), 5),
            "coherence": round(coherence(net), 5),
        },
    )
