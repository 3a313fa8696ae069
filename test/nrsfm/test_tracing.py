"""A trace does what the function does, to the last bit, without calling it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor

from deep_nrsfm_ros.nrsfm import tracing
from deep_nrsfm_ros.nrsfm.anatomy import AnatomyLoss
from deep_nrsfm_ros.nrsfm.keypoints import CMU31
from deep_nrsfm_ros.nrsfm.pool import Pool
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, Anatomy
from deep_nrsfm_ros.nrsfm.tracing import Traced
from deep_nrsfm_ros.nrsfm.trainer import Trainer

STEPS = 6


class Counted:
    """A function that counts its calls."""

    def __init__(self) -> None:
        self.calls = 0

    def call(self, x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        self.calls += 1
        return (x @ y).relu_(), (x + y.mT).sum(0) / len(x)


def test_a_trace_takes_over_and_gives_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracing, "OFTEN", 2)
    function = Counted()
    traced = Traced(function.call)
    for i in range(5):
        for rows in (3, 7):
            given = torch.randn(rows, 4), torch.randn(4, rows)
            expected = Counted().call(*given)
            for found, wanted in zip(traced(*given), expected, strict=True):
                assert torch.equal(found, wanted)
        # Twice by itself, once for the trace, of each number of rows.
        assert function.calls == 2 * min(i + 1, 3)


def test_a_torch_without_traces_does_without(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracing, "OFTEN", 0)
    monkeypatch.delattr(torch.jit, "trace")
    function = Counted()
    traced = Traced(function.call)
    for _ in range(3):
        traced(torch.ones(2, 2), torch.ones(2, 2))
    assert function.calls == 3


@pytest.mark.parametrize("network", ["default", "paper"])
@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("known_object", [False, True])
def test_a_training_is_the_same_to_the_last_bit(
    network: str, gaps: bool, known_object: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    points = rng.standard_normal((50, len(CMU31), 2)).astype(np.float32)
    visible = rng.random((50, len(CMU31))) < (0.8 if gaps else 1)
    preset = PRESETS[network]
    recipe = dataclasses.replace(preset.recipe, batch=8, noise=0.1, mask=0.2 if gaps else 0.0)
    anatomy = AnatomyLoss(Anatomy(bones=1.0, flat=0.1), CMU31) if known_object else None

    def weights(often: int) -> Tensor:
        monkeypatch.setattr(tracing, "OFTEN", often)
        trainer = Trainer(
            Pool.of(points, visible), preset._replace(recipe=recipe), 0, anatomy=anatomy
        )
        for _ in range(STEPS):
            trainer.advance()
        return trainer.weights

    assert torch.equal(weights(often=2), weights(often=STEPS))
