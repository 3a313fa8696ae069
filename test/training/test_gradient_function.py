# SPDX-License-Identifier: Apache-2.0
"""The gradient function for networks that torch computes, and the weight vector."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from deep_nrsfm_ros.nrsfm.losses import Batch, Objective
from deep_nrsfm_ros.nrsfm.network import Architecture, Network, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import Recipe
from deep_nrsfm_ros.training.gradient_function import (
    GradientFunction,
    weight_vector,
    with_weights,
)


def network(architecture: Architecture, p: int) -> Network:
    """Return a float32 network of random weights, whitening included."""
    rng = np.random.default_rng(0)
    net = initialise(architecture, p, rng, paper_initialisation=True).map(torch.from_numpy)
    Q, _ = np.linalg.qr(rng.standard_normal((p, p)))
    L = torch.from_numpy((Q * rng.uniform(0.2, 2, p)) @ Q.T).float()
    return Network.from_named_weights(
        architecture, dict(net.named_weights()) | {"L": L, "L_inverse": torch.linalg.inv(L)}
    )


def batch(p: int) -> tuple[Batch, torch.Tensor]:
    """Return frames with gaps, and known shapes."""
    generator = torch.Generator().manual_seed(0)
    points, known, hidden = (
        torch.randn(*shape, generator=generator) for shape in ((5, p, 2), (4, p, 3), (5, p, 1))
    )
    mask = (hidden < 1).float()
    mask[:, :3] = 1
    return Batch(points * mask, mask), known - known.mean(1, keepdim=True)


@pytest.mark.parametrize(
    "options", [{"threshold": "block"}, {"recovery": "closed_form"}, {"camera": "free"}]
)
def test_every_option_has_a_gradient(options: dict[str, Any]) -> None:
    objective, net = Objective(Normaliser(), Recipe()), network(Architecture((6, 4), **options), 5)
    frames, known = batch(5)
    function, weights = GradientFunction(objective, net, 5), weight_vector(net)
    assert not function.compiled
    losses, gradient = function(weights, frames, known, torch.Generator())
    expected = objective(net, frames, known, torch.Generator())
    torch.testing.assert_close(losses.total, expected.total)
    assert not losses.total.requires_grad and not weights.requires_grad
    heads = {"code_head", "camera_head"} if "recovery" in options else set()
    for name, bar in with_weights(net, gradient).trainable_weights():
        assert bool(bar.any()) == (name not in heads), name


def test_a_weight_vector_is_seen_through_its_network() -> None:
    net = network(Architecture((6, 4)), 5)
    weights = weight_vector(net)
    views = with_weights(net, weights)
    for (name, weight), (same, view) in zip(
        net.trainable_weights(), views.trainable_weights(), strict=True
    ):
        assert name == same and torch.equal(weight, view)
    weights.zero_()
    assert not any(view.any() for _, view in views.trainable_weights())
    assert torch.equal(views.L, net.L)
