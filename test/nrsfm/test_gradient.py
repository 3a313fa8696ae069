"""The gradient written out against torch's own, and its camera against finite differences."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros.nrsfm.geometry import polar
from deep_nrsfm_ros.nrsfm.gradient import differentiable, polar_gradient
from deep_nrsfm_ros.nrsfm.network import Architecture, Network, encode, forward, initialise

some = settings(max_examples=25, deadline=None)
widths = st.lists(st.integers(1, 6), min_size=1, max_size=4).map(tuple)


def tensors(architecture: Architecture, p: int, seed: int) -> Network:
    """Return a float64 network of random weights, whitening included."""
    rng = np.random.default_rng(seed)
    net = initialise(architecture, p, rng, as_released=True)
    Q, _ = np.linalg.qr(rng.standard_normal((p, p)))
    L = torch.from_numpy((Q * rng.uniform(0.2, 2, p)) @ Q.T)
    weights = {name: torch.from_numpy(w.astype(float)) for name, w in net.named()}
    weights |= {"L": L, "L_inverse": torch.linalg.inv(L)}
    return Network.from_named(architecture, weights)


@some
@given(widths, st.integers(3, 7), st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.5]))
def test_it_is_the_gradient_that_torch_finds(
    widths: tuple[int, ...], p: int, seed: int, whitening: float
) -> None:
    net = tensors(Architecture(widths, whitening=whitening), p, seed)
    learned = [w.requires_grad_() for _, w in net.learned()]
    generator = torch.Generator().manual_seed(seed)
    W, S_bar, M_bar = (
        torch.randn(5, *shape, generator=generator, dtype=torch.float64)
        for shape in ((p, 2), (p, 3), (3, 2))
    )

    def gradients(function: object) -> tuple[torch.Tensor, ...]:
        S, M = function(net, W)  # type: ignore[operator]
        return torch.autograd.grad((S * S_bar).sum() + (M * M_bar).sum(), learned)

    size = torch.linalg.svdvals((encode(net, W)[-1] @ net.camera_head)[..., 0])
    if (size[:, 1] < 0.01 * size[:, 0]).any() or not size.all():
        return  # hardly a camera: its gradient is large, and torch's own not exact
    for (name, _), ours, theirs in zip(
        net.learned(), gradients(differentiable), gradients(forward), strict=True
    ):
        torch.testing.assert_close(ours, theirs, rtol=1e-7, atol=1e-7, msg=name)


def test_every_option_has_a_gradient() -> None:
    for options in (("block",), ("relu", "closed_form"), ("relu", "learned", "free")):
        net = tensors(Architecture((6, 4), *options), 5, 0)
        for _, weight in net.learned():
            weight.requires_grad_()
        W = torch.randn(3, 5, 2, dtype=torch.float64)
        S, _ = differentiable(net, W)
        S.sum().backward()
        assert net.D[0].grad is not None and net.D[0].grad.any()
        torch.testing.assert_close(S, forward(net, W)[0])


def test_polar_gradient_is_that_of_small_changes() -> None:
    generator = torch.Generator().manual_seed(0)
    A, dA, R_bar = (
        torch.randn(20, 2, 3, generator=generator, dtype=torch.float64) for _ in range(3)
    )
    h = 1e-6
    change = (polar(A + h * dA) - polar(A - h * dA)) / (2 * h)
    found = polar_gradient(A, polar(A), R_bar)
    torch.testing.assert_close((found * dA).sum(), (change * R_bar).sum(), rtol=1e-6, atol=0)


def test_no_camera_gives_no_gradient() -> None:
    nothing = torch.zeros(1, 2, 3)
    assert not polar_gradient(nothing, polar(nothing), torch.ones(1, 2, 3)).any()
