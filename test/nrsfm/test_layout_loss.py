# SPDX-License-Identifier: Apache-2.0
"""Bones that keep their lengths and fronts in front, against a slow form and in a training."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import CMU31, HUMAN17
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras
from deep_nrsfm_ros.nrsfm.handedness import votes
from deep_nrsfm_ros.nrsfm.layout_loss import LayoutLoss
from deep_nrsfm_ros.nrsfm.network import Architecture, reconstruct
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, LayoutLossWeights
from deep_nrsfm_ros.training.loop import train
from deep_nrsfm_ros.training.setup import Setup

ANIMAL = KeypointLayout(
    "animal",
    ("left_hip", "right_hip", "neck", "nose", "left_foot", "right_foot"),
    edges=(
        ("left_hip", "left_foot"),
        ("right_foot", "right_hip"),
        ("neck", "nose"),
        ("left_hip", "right_hip"),
        ("neck", "left_hip"),
    ),
    handedness=(("left_hip", "right_hip", "neck", "nose"),),
)
# x right, y down, z forward: it stands with its nose towards the camera.
STANDING = np.array(
    [[0.3, 0, 0], [-0.3, 0, 0], [0, -1, 0], [0, -1, -0.5], [0.3, 1, 0], [-0.3, 1, 0]]
)

some = settings(max_examples=25, deadline=None)
seeds = st.integers(0, 2**32 - 1)


def cameras(seed: int, f: int = 7) -> torch.Tensor:
    return torch.from_numpy(random_cameras(f, np.random.default_rng(seed))).double()


def shapes(seed: int, f: int = 7) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    return torch.from_numpy(STANDING + 0.3 * rng.standard_normal((f, 6, 3)))


@some
@given(seeds)
def test_bones_by_the_book(seed: int) -> None:
    S = shapes(seed).numpy()
    edges = [(0, 4), (5, 1), (2, 3), (0, 1), (2, 0)]
    partners = [1, 0, 2, 3, 4]  # neck to right hip is no edge
    lengths = np.array([[np.linalg.norm(one[a] - one[b]) for a, b in edges] for one in S])
    shares = lengths / lengths.sum(1, keepdims=True)
    means = shares.mean(0)
    expected = np.mean(
        [
            np.mean((shares[:, e] / mean - 1) ** 2)
            + (2 * (mean - means[other]) / (mean + means[other])) ** 2
            for e, (mean, other) in enumerate(zip(means, partners, strict=True))
        ]
    )
    found = LayoutLoss(LayoutLossWeights(bone_length_weight=2.0), ANIMAL)(
        torch.from_numpy(S), cameras(seed)
    )
    np.testing.assert_allclose(found, 2 * expected, rtol=1e-6)


def test_the_gradient_of_bones_is_that_of_their_differences() -> None:
    S = shapes(0).requires_grad_()
    loss = LayoutLoss(LayoutLossWeights(bone_length_weight=2.0), ANIMAL)
    assert torch.autograd.gradcheck(lambda S: loss(S, cameras(0)), S)


@some
@given(seeds)
def test_the_front_is_what_the_handedness_votes_on(seed: int) -> None:
    S = shapes(seed)
    missed = np.maximum(0.1 - votes(S.numpy(), ANIMAL), 0).mean()
    found = LayoutLoss(LayoutLossWeights(handedness_weight=3.0), ANIMAL)(S, cameras(seed))
    np.testing.assert_allclose(found, 3 * missed, rtol=1e-6, atol=1e-9)


@some
@given(seeds)
def test_depth_is_what_the_image_does_not_show(seed: int) -> None:
    S, M = centre(shapes(seed).numpy()), cameras(seed).numpy()
    third = np.cross(M[:, :, 0], M[:, :, 1])
    depths = np.einsum("fpr,fr->fp", S, third)
    expected = ((depths**2).sum(1) / ((S @ M) ** 2).sum((1, 2))).mean()
    found = LayoutLoss(LayoutLossWeights(depth_penalty=2.0), ANIMAL)(
        torch.from_numpy(S) + 5, cameras(seed)
    )
    np.testing.assert_allclose(found, 2 * expected, rtol=1e-6)


@some
@given(seeds, st.floats(0.1, 10))
def test_neither_place_nor_turn_nor_size_matters(seed: int, size: float) -> None:
    S, M, loss = shapes(seed), cameras(seed), LayoutLoss(LayoutLossWeights(1.0, 1.0, 1.0), ANIMAL)
    Q, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    Q *= np.sign(np.linalg.det(Q))
    turn = torch.from_numpy(Q)
    moved = size * S @ turn + torch.arange(3)
    torch.testing.assert_close(loss(moved, turn.mT @ M), loss(S, M), rtol=1e-5, atol=1e-7)


def judge(name: str) -> Callable[[torch.Tensor], float]:
    """Return the loss by one weight alone, of shapes seen along z."""
    loss = LayoutLoss(LayoutLossWeights(**{name: 1.0}), ANIMAL)
    return lambda S: float(loss(S, torch.eye(3, dtype=S.dtype)[:, :2].expand(len(S), 3, 2)))


def test_a_sound_body_costs_nothing_and_its_mirror_image_does() -> None:
    S = torch.from_numpy(np.repeat(STANDING[None], 4, 0))
    bones, front = (judge(name) for name in ("bone_length_weight", "handedness_weight"))
    assert bones(S) < 1e-12 and front(S) == 0
    mirrored = S * torch.tensor([1, 1, -1])
    assert bones(mirrored) < 1e-12 and front(mirrored) > 0.1
    one_leg_long = S.clone()
    one_leg_long[:, 4, 1] = 2
    assert bones(one_leg_long) > 0.01 and front(one_leg_long) == 0


def test_axes_that_are_mirrored_have_the_front_on_the_other_side() -> None:
    weights, M, S = LayoutLossWeights(handedness_weight=1.0), cameras(0), shapes(0)
    plain = LayoutLoss(weights, ANIMAL)
    mirrored = LayoutLoss(weights, ANIMAL, mirrored_axes=True)
    reflection = torch.tensor([1.0, 1.0, -1.0])
    torch.testing.assert_close(mirrored(S * reflection, M), plain(S, M))
    assert not torch.isclose(mirrored(S, M), plain(S, M))


def test_the_gradient_is_that_of_small_changes() -> None:
    S, M, loss = shapes(0), cameras(0), LayoutLoss(LayoutLossWeights(3.0, 1.0, 0.5), ANIMAL)
    change = torch.from_numpy(np.random.default_rng(1).standard_normal(S.shape))
    h = 1e-6
    expected = (loss(S + h * change, M) - loss(S - h * change, M)) / (2 * h)
    S.requires_grad_()
    found = (torch.autograd.grad(loss(S, M), S)[0] * change).sum()
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-9)


def test_a_layout_must_have_what_is_asked_for() -> None:
    bare = KeypointLayout.numbered(5)
    with pytest.raises(
        ValueError, match="bone_length_weight is 2, but layout 'points5' has no edges; add some"
    ):
        LayoutLoss(LayoutLossWeights(bone_length_weight=2.0), bare)
    with pytest.raises(
        ValueError, match="handedness_weight is 1, but layout 'points5' has no handedness"
    ):
        LayoutLossWeights(handedness_weight=1.0).check(bare)
    LayoutLossWeights().check(bare)
    for layout in (HUMAN17, CMU31):
        LayoutLoss(LayoutLossWeights(1.0, 1.0, 1.0), layout)


def test_a_training_heeds_it() -> None:
    rng = np.random.default_rng(0)
    bent = np.repeat(STANDING[None], 300, 0)
    bent[:, 4:, 2] += rng.standard_normal((300, 2))  # feet of any length, before it or behind
    seen = (centre(bent) @ random_cameras(300, rng)).astype(np.float32)
    preset = PRESETS["default"]
    preset = preset._replace(
        architecture=Architecture((24, 12)),
        recipe=dataclasses.replace(preset.recipe, steps=300, seeds=1),
    )
    found = []
    for loss in (
        None,
        LayoutLoss(LayoutLossWeights(bone_length_weight=3.0, handedness_weight=1.0), ANIMAL),
    ):
        trainer = train(seen, np.ones((300, 6), bool), preset, Setup(layout_loss=loss))
        net = trainer.net.map(lambda w: w.numpy())
        S, _ = reconstruct(net, preset.normaliser.encode(seen, np.ones((300, 6, 1))).W)
        found.append(
            [
                judge(name)(torch.from_numpy(S))
                for name in ("bone_length_weight", "handedness_weight")
            ]
        )
    without, heeded = found
    assert heeded[0] < 0.5 * without[0] and heeded[1] < 0.5 * without[1] + 1e-3
    assert all(a != b for a, b in pairwise(found))
