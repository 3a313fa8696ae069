# SPDX-License-Identifier: Apache-2.0
"""The training loss against explicit loops over frames and visible points."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from deep_nrsfm_ros.nrsfm.geometry import centre
from deep_nrsfm_ros.nrsfm.losses import Batch, Losses, Objective
from deep_nrsfm_ros.nrsfm.network import Architecture, Network, complete, forward, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import Recipe

P, BATCH = 8, 6
PLAIN = Recipe(cycle=0.0)
both_scales = pytest.mark.parametrize("scale", ["rms", "none"])


def network(camera: str = "orthonormal", whitening: float = 0.0) -> Network:
    rng = np.random.default_rng(0)
    architecture = Architecture((12, 9), camera=camera, whitening=whitening)
    net = initialise(architecture, P, rng, paper_initialisation=True).map(lambda w: w.astype(float))
    A = 0.2 * rng.standard_normal((P, P))
    L = np.eye(P) + A + A.T
    return dataclasses.replace(net, L=L, L_inverse=np.linalg.inv(L))


def batch(incomplete: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return points (b, p, 2) away from the origin and visibility (b, p)."""
    rng = np.random.default_rng(1)
    visible = rng.random((BATCH, P)) < (0.6 if incomplete else 1)
    visible[:, :3] = True
    points = np.where(visible[..., None], rng.standard_normal((BATCH, P, 2)) + [30, -20], 0)
    return points, visible


def losses(
    net: Network,
    data: tuple[np.ndarray, np.ndarray],
    recipe: Recipe,
    scale: str = "rms",
    *,
    whitened: bool = True,
    known: np.ndarray | None = None,
) -> Losses:
    """Return the losses in float32, as training computes them."""
    points, visible = (torch.from_numpy(array.astype(np.float32)) for array in data)
    tensors = net.map(lambda w: torch.from_numpy(w.astype(np.float32)))
    frames = Batch(points, visible[..., None])
    objective = Objective(Normaliser(scale), recipe, whitened=whitened)
    shapes = None if known is None else torch.from_numpy(known.astype(np.float32))
    return objective(tensors, frames, shapes, torch.Generator().manual_seed(5))


def only(net: Network, seen: np.ndarray) -> Network:
    """Return the network of an object that has just the points `seen`."""
    D, b_ = (net.D[0][seen], *net.D[1:]), (net.b_[0][seen], *net.b_[1:])
    return dataclasses.replace(net, D=D, b_=b_)


def normalised(points: np.ndarray, scale: str) -> np.ndarray:
    W = points - points.mean(0)
    return W / (2 * (W**2).sum(1).mean() ** 0.5) if scale == "rms" else W


@both_scales
@pytest.mark.parametrize("incomplete", [False, True])
def test_reprojection_loss_is_that_of_the_visible_points_alone(
    scale: str, incomplete: bool
) -> None:
    net, (points, visible) = network(), batch(incomplete)
    expected = []
    for frame, seen in zip(points, visible, strict=True):
        W = normalised(frame[seen], scale)
        S, M = forward(only(net, seen), W * P / seen.sum())
        error = W - (S @ M - (S @ M).mean(0))
        expected.append(np.linalg.norm(error) / np.linalg.norm(W))
    found = losses(net, (points, visible), PLAIN, scale)
    assert found.reprojection.item() == pytest.approx(np.mean(expected), rel=1e-4)
    assert found.total.item() == found.reprojection.item() and found.cycle.item() == 0
    assert np.mean(expected) > 0.1


@both_scales
def test_a_whitened_net_weighs_differences_by_its_whitening(scale: str) -> None:
    net, (points, visible) = network(whitening=1.0), batch(incomplete=True)
    whitened, plain = [], []
    for frame, seen in zip(points, visible, strict=True):
        filled, _ = complete(net, frame[None], seen[None, :, None] * 1.0)
        x = normalised(filled[0], scale)
        unit = np.linalg.norm(filled[0] - filled[0].mean(0)) / np.linalg.norm(x)
        W, error = np.zeros((P, 2)), np.zeros((P, 2))
        W[seen] = (frame[seen] - frame[seen].mean(0)) / unit
        S, M = forward(net, x)
        error[seen] = W[seen] - ((S @ M)[seen] - (S @ M)[seen].mean(0))
        whitened.append(np.linalg.norm(net.L @ error) / np.linalg.norm(net.L @ W))
        plain.append(np.linalg.norm(error) / np.linalg.norm(W))
    found = losses(net, (points, visible), PLAIN, scale).reprojection.item()
    assert found == pytest.approx(np.mean(whitened), rel=1e-4)
    found = losses(net, (points, visible), PLAIN, scale, whitened=False).reprojection.item()
    assert found == pytest.approx(np.mean(plain), rel=1e-4)
    assert abs(np.mean(plain) - np.mean(whitened)) > 1e-3


@both_scales
@pytest.mark.parametrize("whitened", [False, True])
def test_frames_without_a_gap_have_the_losses_of_a_mask_of_ones(scale: str, whitened: bool) -> None:
    net = network(whitening=1.0).map(torch.from_numpy)
    points, visible = (torch.from_numpy(array) for array in batch(incomplete=False))
    known = torch.from_numpy(centre(np.random.default_rng(2).standard_normal((BATCH, P, 3))))
    objective = Objective(Normaliser(scale), Recipe(), whitened=whitened)
    frames = Batch(points.float(), visible[..., None].float())
    single = net.map(torch.Tensor.float)
    task = objective.task(single, frames, known.float(), torch.Generator().manual_seed(5))
    assert task.mask is None and task.T is not None
    task = task._replace(x=task.x.double(), W=task.W.double(), T=task.T.double())
    outputs = [output.requires_grad_() for output in forward(net, task.x)]
    results = []
    for mask in (None, torch.ones(BATCH, 1, P, dtype=torch.float64)):
        found = objective.losses(net, task._replace(mask=mask), *outputs)
        results.append((*found, *torch.autograd.grad(found.total, outputs)))
    for fast, masked in zip(*results, strict=True):
        torch.testing.assert_close(fast, masked)


def test_known_shapes_are_seen_by_the_cameras_that_are_given_for_them() -> None:
    net = network(whitening=1.0).map(torch.from_numpy).map(torch.Tensor.float)
    points, visible = (torch.from_numpy(array) for array in batch(incomplete=False))
    known = torch.from_numpy(centre(np.random.default_rng(2).standard_normal((BATCH, P, 3))))
    frames = Batch(points.float(), visible[..., None].float())
    objective = Objective(Normaliser("none"), Recipe())
    args = net, frames, known.float(), torch.Generator()
    random = objective.task(*args[:3], args[3].manual_seed(5)).x[BATCH:]
    x = objective.task(*args[:3], args[3].manual_seed(5), torch.eye(2, 3)[None]).x[BATCH:]
    torch.testing.assert_close(x[0], known[0, :, :2].float())
    torch.testing.assert_close(x[1:], random[1:])
    assert not torch.allclose(x[0], random[0])


def test_what_a_missing_point_holds_does_not_matter() -> None:
    points, visible = batch(incomplete=True)
    filled = np.where(visible[..., None], points, 123.0)
    a, b = (losses(network(), (x, visible), Recipe(added_noise=0.1)) for x in (points, filled))
    # The random numbers are the same, so noise, cameras and losses must be.
    for x, y in zip(a, b, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-5)


@both_scales
def test_the_shapes_are_back_projected(scale: str) -> None:
    net, (points, visible) = network(), batch(incomplete=False)
    found = losses(net, (points, visible), PLAIN, scale).shapes
    for frame, T in zip(points, found, strict=True):
        W = normalised(frame, scale)
        S, M = forward(net, W)
        expected = S + (W - (S @ M - (S @ M).mean(0))) @ M.T
        np.testing.assert_allclose(T, expected - expected.mean(0), atol=1e-5)


@both_scales
def test_cycle_loss_sees_known_shapes_by_other_cameras(scale: str) -> None:
    net, (points, visible) = network(), batch(incomplete=False)
    known = np.random.default_rng(2).standard_normal((BATCH - 1, P, 3))
    known -= known.mean(1, keepdims=True)
    draws = torch.randn(BATCH - 1, 2, 3, generator=torch.Generator().manual_seed(5))
    expected = []
    for T, draw in zip(known, draws.numpy().astype(float), strict=True):
        U, _, Vt = np.linalg.svd(draw, full_matrices=False)
        seen = T @ (U @ Vt).T
        again, _ = forward(net, normalised(seen, scale))
        T *= np.linalg.norm(normalised(seen, scale)) / np.linalg.norm(seen)
        expected.append(np.linalg.norm(again - again.mean(0) - T) / np.linalg.norm(T))
    alone = losses(net, (points, visible), PLAIN, scale)
    found = losses(net, (points, visible), Recipe(cycle=0.7), scale, known=known)
    assert found.cycle.item() == pytest.approx(np.mean(expected), rel=1e-4)
    assert found.reprojection.item() == pytest.approx(alone.reprojection.item(), rel=1e-5)
    assert found.total.item() == pytest.approx((found.reprojection + 0.7 * found.cycle).item())
    assert found.cycle.item() > 0.1


def test_a_free_camera_is_held_by_its_spectral_norm() -> None:
    net, (points, visible) = network("free"), batch(incomplete=False)
    cameras = [forward(net, normalised(frame, "rms"))[1] for frame in points]
    held = np.mean([np.linalg.norm(M, 2) for M in cameras])
    found = losses(net, (points, visible), dataclasses.replace(PLAIN, spectral=3.0))
    assert (found.total - found.reprojection).item() == pytest.approx(3 * held, rel=1e-4)
    assert held > 0.01
    orthonormal = losses(network(), (points, visible), dataclasses.replace(PLAIN, spectral=3.0))
    assert orthonormal.total.item() == orthonormal.reprojection.item()


@pytest.mark.parametrize("recovery", ["learned", "closed_form"])
@pytest.mark.parametrize("threshold", ["relu", "block"])
def test_the_gradient_reaches_every_weight(threshold: str, recovery: str) -> None:
    architecture = Architecture((12, 9), threshold, recovery)
    net = initialise(architecture, P, np.random.default_rng(0)).map(
        lambda w: torch.from_numpy(w).requires_grad_()
    )
    points, visible = batch(incomplete=True)
    frames = Batch(
        torch.from_numpy(points.astype(np.float32)),
        torch.from_numpy(visible[..., None].astype(np.float32)),
    )
    recipe = Recipe(added_noise=0.1, mask=0.3)
    Objective(Normaliser(), recipe)(net, frames, None, torch.Generator()).total.backward()
    heads = {"code_head", "camera_head"} if recovery == "closed_form" else set()
    for name, weight in net.trainable_weights():
        if name in heads:
            assert weight.grad is None
        else:
            assert torch.isfinite(weight.grad).all() and weight.grad.any(), name


def test_noise_and_hidden_points_spoil_the_input_not_the_target(trained: Any, figure: Any) -> None:
    net, f = trained.net, 500
    points = torch.from_numpy(figure.points[:f])
    frames = Batch(points, torch.ones(f, points.shape[1], 1))

    def reprojection(**augmentation: Any) -> float:
        recipe = Recipe(cycle=0.0, **augmentation)
        return Objective(Normaliser(), recipe)(
            net, frames, None, torch.Generator()
        ).reprojection.item()

    clean = reprojection()
    assert clean < 0.1
    assert clean < reprojection(added_noise=0.2) < reprojection(added_noise=0.8)
    assert clean < reprojection(mask=0.2) < reprojection(mask=0.8)


@pytest.mark.parametrize("visible", [0, 1])
def test_a_frame_with_nothing_to_see_gives_no_gradient(visible: int) -> None:
    net = network().map(lambda w: torch.from_numpy(w).requires_grad_())
    mask = torch.zeros(1, P, 1, dtype=torch.float64)
    mask[:, :visible] = 1
    frames = Batch(torch.ones(1, P, 2, dtype=torch.float64) * 30 * mask, mask)
    losses = Objective(Normaliser(), PLAIN)(net, frames, None, torch.Generator())
    losses.total.backward()
    assert torch.isfinite(losses.total)
    for _, weight in net.trainable_weights():
        assert weight.grad is None or not weight.grad.any()
