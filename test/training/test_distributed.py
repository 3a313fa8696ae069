# SPDX-License-Identifier: Apache-2.0
"""Two processes that torchrun has started train what one process trains."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from deep_nrsfm_ros.nrsfm.losses import Batch
from deep_nrsfm_ros.training.distributed import ALONE, ProcessGroup, join, rank
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.limits import Limits
from deep_nrsfm_ros.training.loop import train
from deep_nrsfm_ros.training.setup import Setup
from deep_nrsfm_ros.training.trainer import Trainer
from test.fixtures.forked_python import TRAINING, run_forked

WORK = Path(__file__).with_name("processes.py")
TOLERANCE = 0.1
"""Of the errors of a short training: other random batches differ as much."""


def load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


PRESET = load(WORK).PRESET


@pytest.fixture(scope="module")
def found(figure: Any, tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, torch.Tensor]]:
    """What two processes found."""
    folder = tmp_path_factory.mktemp("processes")
    np.save(folder / "points.npy", figure.points)
    words = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", WORK, folder)
    run_forked(words, TRAINING, forks=True).check_returncode()
    assert (folder / "checkpoint").exists()
    return [load_file(folder / f"{i}.safetensors") for i in range(2)]


def test_the_first_step_is_that_of_one_process_with_both_batches(
    figure: Any, found: list[dict[str, torch.Tensor]]
) -> None:
    points = torch.from_numpy(figure.points)
    alone = Trainer(FrameStore.of(figure.points, np.ones(points.shape[:2], bool)), PRESET, 0)
    assert [len(part["batch"]) for part in found] == [32, 33]
    batch = torch.cat([part["batch"] for part in found])
    assert len(batch.unique(dim=0)) > 60  # each draws its own
    both = Batch(batch, torch.ones_like(batch[..., :1]))
    _, gradient = alone.gradient_function(alone.weights, both, None, alone.generator)
    for part in found:
        torch.testing.assert_close(part["L"], alone.initial.L, rtol=0, atol=1e-5)
        torch.testing.assert_close(part["gradient"], gradient, rtol=0, atol=1e-6)


def test_two_processes_agree_with_one(figure: Any, found: list[dict[str, torch.Tensor]]) -> None:
    visible = np.ones(figure.points.shape[:2], bool)
    alone = train(figure.points, visible, PRESET, Setup(limits=Limits()))
    first, second = found
    torch.testing.assert_close(first["weights"], second["weights"], rtol=0, atol=0)
    np.testing.assert_allclose(first["errors"], alone.measure(), rtol=TOLERANCE)
    assert int(first["frames"]) == len(visible)
    # At least the last report: a slow machine has one every five seconds besides.
    assert int(first["reports"]) >= 1 and int(second["reports"]) == 0


def test_all_stop_when_one_wants_to_and_all_go_on(found: list[dict[str, torch.Tensor]]) -> None:
    # Asked every 16 steps, the last process says so after 96: 40 of screening, 56 after that.
    for part in found:
        assert part["resumed"] == part["stopped"] == 20 + 56
        assert part["resumed_to"] == PRESET.recipe.steps


def test_who_leaves_has_no_thread_of_the_team_that_could_abort_it(
    found: list[dict[str, torch.Tensor]],
) -> None:
    assert [int(part["threads"]) for part in found] == [0, 0]


def test_shares_add_up() -> None:
    class Part(ProcessGroup):
        def __init__(self, rank: int, size: int) -> None:
            self.rank, self.size = rank, size

    groups = [Part(i, 3) for i in range(3)]
    for batch in (3, 64, 65):
        assert sum(group.share(batch) for group in groups) == batch
    frames = torch.arange(10)
    assert sorted(torch.cat([group.shard(frames) for group in groups]).tolist()) == list(range(10))
    with pytest.raises(ValueError, match="3 processes are more than"):
        train(
            np.eye(4, 2, dtype=np.float32)[None],
            np.ones((1, 4), bool),
            PRESET,
            Setup(group=groups[0]),
        )


def test_other_launchers_do_not_make_a_team(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TORCHELASTIC_RUN_ID", raising=False)
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "1")
    assert join() is ALONE and rank() == 0
