# SPDX-License-Identifier: Apache-2.0
"""What each process of test_distributed.py does; writes what it found to `rank.safetensors`."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file

from deep_nrsfm_ros.nrsfm.network import Architecture
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import Preset, Recipe
from deep_nrsfm_ros.training.distributed import ProcessGroup, join, rank
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.limits import Limits
from deep_nrsfm_ros.training.loop import Callbacks, Checkpointing, train
from deep_nrsfm_ros.training.setup import Setup
from deep_nrsfm_ros.training.trainer import Trainer

PRESET = Preset(
    Architecture(widths=(64, 32, 16)),
    Normaliser(),
    Recipe(steps=300, batch=65, learning_rate=1e-2, seeds=2, screening=20),
)


def first_step(points: torch.Tensor, group: ProcessGroup) -> dict[str, torch.Tensor]:
    """Return the gradient of one step, what it was asked on, and the whitening."""
    pool = FrameStore.of(points.numpy(), np.ones(points.shape[:2], bool))
    pool = dataclasses.replace(pool, usable=group.shard(pool.usable))
    trainer = Trainer(pool, PRESET, 0, Setup(group=group))
    batch = trainer.sample(trainer.batch, 0).points
    gradients: list[torch.Tensor] = []
    update = trainer.optimiser.update

    def record(gradient: torch.Tensor, learning_rate: float) -> None:
        gradients.append(gradient.clone())
        update(gradient, learning_rate)

    trainer.optimiser.update = record  # type: ignore[method-assign]
    trainer.advance()
    (gradient,) = gradients
    return {"batch": batch, "gradient": gradient, "L": trainer.initial.L}


def main(folder: Path) -> None:
    """Take one step, train, train until one process wants to stop, and go on."""
    torch.set_num_threads(1)
    points = np.load(folder / "points.npy")
    data = points, np.ones(points.shape[:2], bool), PRESET
    group = join()
    found = first_step(torch.from_numpy(points), group)
    reports: list[object] = []
    trainer = train(
        *data, Setup(limits=Limits(), group=group), Callbacks(on_progress=reports.append)
    )
    errors = group.mean(trainer.measure())
    found |= {"weights": trainer.weights, "errors": torch.tensor(errors)}
    found |= {"reports": torch.tensor(len(reports)), "frames": torch.tensor(trainer.total_frames)}

    asked = 0

    def stop() -> bool:
        nonlocal asked
        asked += 1
        return rank() == group.size - 1 and asked > 6

    file = folder / "checkpoint"
    stopped = train(*data, Setup(group=group), Callbacks(should_stop=stop), Checkpointing(file))
    found["stopped"] = torch.tensor(stopped.step)
    first: list[int] = []
    note = Callbacks(on_step=lambda trainer: first.append(trainer.step))
    train(*data, Setup(group=group), note, Checkpointing(file))
    found |= {"resumed": torch.tensor(first[0]), "resumed_to": torch.tensor(first[-1])}
    group.close()
    names = [(task / "comm").read_text() for task in Path("/proc/self/task").iterdir()]
    found["threads"] = torch.tensor(sum("gloo" in name for name in names))
    save_file(found, folder / f"{rank()}.safetensors")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
