# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import torch
from torch import Tensor

from deep_nrsfm_ros.training.adam import Adam
from deep_nrsfm_ros.training.distributed import ProcessGroup, Value
from deep_nrsfm_ros.training.soap import Soap

SHAPES = ((20, 3, 10), (40, 30), (7,), (40, 4))
COUNT = 600 + 1200 + 7 + 160


def gradients(count: int, size: int = COUNT) -> list[Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(size, generator=generator) for _ in range(count)]


def test_vectors_and_narrow_matrices_take_twice_the_steps_of_adam() -> None:
    ours, theirs = torch.zeros(COUNT), torch.zeros(COUNT)
    soap, adam = Soap(ours, SHAPES), Adam(theirs)
    for gradient in gradients(50):
        soap.update(gradient, 0.01)
        adam.update(gradient, 0.02)
    torch.testing.assert_close(ours[1800:], theirs[1800:])
    assert not torch.allclose(ours[:1800], theirs[:1800], atol=1e-3)
    assert soap.learning_rate == 0.01


def test_the_axes_diagonalise_the_second_moment_on_the_smaller_side() -> None:
    soap = Soap(torch.zeros(1200), [(40, 30)])
    scales = torch.linspace(1, 5, 30)
    mixing = torch.linalg.qr(torch.randn(30, 30, generator=torch.Generator().manual_seed(1)))[0]
    for gradient in gradients(41, 1200):
        soap.update((gradient.view(40, 30) * scales @ mixing).flatten(), 0.01)
    axes = soap.moments["axes"].view(30, 30)
    torch.testing.assert_close(axes.T @ axes, torch.eye(30), rtol=0, atol=1e-5)
    rotated = axes.T @ soap.moments["covariance"].view(30, 30) @ axes
    spread = rotated.diagonal()
    assert (rotated - spread.diag()).norm() < 1e-4 * spread.norm()
    assert spread[-1] > 5 * spread[0]


def test_it_does_not_depend_on_the_axes_that_the_weights_are_written_in() -> None:
    """What Adam lacks: rotated gradients give rotated steps."""
    Q = torch.linalg.qr(torch.randn(30, 30, generator=torch.Generator().manual_seed(1)))[0]
    plain, rotated = torch.zeros(1200), torch.zeros(1200)
    here, there = Soap(plain, [(40, 30)]), Soap(rotated, [(40, 30)])
    for gradient in gradients(30, 1200):
        here.update(gradient, 0.01)
        there.update((gradient.view(40, 30) @ Q).flatten(), 0.01)
    torch.testing.assert_close(plain.view(40, 30) @ Q, rotated.view(40, 30), rtol=0, atol=4e-3)


def test_it_reaches_a_minimum_that_is_long_and_narrow_before_adam_does() -> None:
    generator = torch.Generator().manual_seed(2)
    A = torch.linalg.qr(torch.randn(32, 32, generator=generator))[0] * torch.logspace(0, -2, 32)
    target = torch.randn(32, 48, generator=generator)

    def loss_after(weights: Tensor, optimiser: Adam | Soap, rate: float) -> float:
        for step in range(300):
            error = A.T @ (weights.view(32, 48) - target)
            optimiser.update((A @ error).flatten(), rate * (1 - step / 300))
        return float((A.T @ (weights.view(32, 48) - target)).norm())

    soap, adam = torch.zeros(32 * 48), torch.zeros(32 * 48)
    assert loss_after(soap, Soap(soap, [(32, 48)]), 0.05) < 0.5 * loss_after(adam, Adam(adam), 0.1)


def test_it_goes_on_from_its_moments() -> None:
    whole, halves = torch.zeros(COUNT), torch.zeros(COUNT)
    straight, stopped = Soap(whole, SHAPES), Soap(halves, SHAPES)
    for step, gradient in enumerate(gradients(60)):
        if step == 37:
            saved = {name: value.clone() for name, value in stopped.moments.items()}
            stopped = Soap(halves, SHAPES)
            stopped.restore(saved)
        straight.update(gradient, 0.01)
        stopped.update(gradient, 0.01)
    assert torch.equal(whole, halves)


def test_a_group_takes_the_axes_of_the_first_process() -> None:
    first = Soap(torch.zeros(1200), [(40, 30)])
    for gradient in gradients(3, 1200):
        first.update(gradient, 0.01)

    class Second(ProcessGroup):
        rank, size = 1, 2

        def broadcast(self, value: Value) -> Value:
            return first.moments["axes"].view(30, 30)  # type: ignore[return-value]

    second = Soap(torch.zeros(1200), [(40, 30)], Second())
    second.update(gradients(1, 1200)[0] * 2 + 1, 0.01)
    assert torch.equal(second.moments["axes"], first.moments["axes"])
