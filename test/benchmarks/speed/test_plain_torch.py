# SPDX-License-Identifier: Apache-2.0
"""The plain torch training: the same network, the same losses as ours, written otherwise."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from benchmarks.speed.plain_torch import PlainNetwork, PlainTraining
from deep_nrsfm_ros.nrsfm.losses import Batch
from deep_nrsfm_ros.nrsfm.network import forward, initialise
from deep_nrsfm_ros.nrsfm.recipe import PRESETS
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.trainer import Trainer

P = 7


@pytest.fixture
def points() -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(0).standard_normal((20, P, 2), dtype=np.float32))


@pytest.mark.parametrize("name", PRESETS)
def test_computes_what_our_network_does(name: str, points: torch.Tensor) -> None:
    architecture = dataclasses.replace(PRESETS[name].architecture, widths=(16, 12, 8))
    net = initialise(architecture, P, np.random.default_rng(1), paper_initialisation=True)
    rng = np.random.default_rng(2)
    A = (np.eye(P) + 0.05 * rng.standard_normal((P, P))).astype(np.float32)
    net = dataclasses.replace(net, L=A @ A.T, L_inverse=np.linalg.inv(A @ A.T))
    for ours, plain in zip(forward(net, points.numpy()), PlainNetwork(net)(points), strict=True):
        np.testing.assert_allclose(plain.detach().numpy(), ours, rtol=1e-3, atol=1e-4)


def pool(points: torch.Tensor) -> FrameStore:
    return FrameStore.of(points.numpy(), np.ones((len(points), P), bool))


@pytest.mark.parametrize("name", PRESETS)
def test_has_the_same_losses(name: str, points: torch.Tensor) -> None:
    preset = PRESETS[name]
    architecture = dataclasses.replace(preset.architecture, widths=(16, 12, 8))
    preset = preset._replace(
        architecture=architecture, recipe=dataclasses.replace(preset.recipe, batch=len(points))
    )
    frames = Batch(points, torch.ones(len(points), P, 1))
    ours = Trainer(pool(points), preset, 0)
    plain = PlainTraining(ours.net, points, preset)
    generator = torch.Generator().manual_seed(3)
    shapes = ours.objective(ours.net, frames, None, generator).shapes
    losses = ours.objective(ours.net, frames, shapes, generator)
    torch.manual_seed(3)  # the same random cameras
    assert plain.loss(points).item() == pytest.approx(losses.total.item(), rel=1e-4)
    assert (losses.cycle.item() > 0) == (name != "paper")


def test_its_steps_lower_the_loss(points: torch.Tensor) -> None:
    preset = PRESETS["paper"]
    plain = PlainTraining(Trainer(pool(points), preset, 0).initial, points, preset)
    before = plain.loss(points).item()
    for _ in range(20):
        plain.advance()
    assert plain.loss(points).item() < before
