"""The gradient written out against torch's own, and its camera against finite differences."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.nrsfm.geometry import polar
from deep_nrsfm_ros.nrsfm.layout_loss import LayoutLoss
from deep_nrsfm_ros.nrsfm.losses import Frames, Objective
from deep_nrsfm_ros.nrsfm.network import Architecture, Network, encode, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import LayoutLossWeights, Recipe
from deep_nrsfm_ros.training.gradient_function import GradientFunction, _by_torch, polar_gradient

some = settings(max_examples=25, deadline=None)
widths = st.lists(st.integers(1, 6), min_size=1, max_size=4).map(tuple)


def tensors(architecture: Architecture, p: int, seed: int) -> Network:
    """Return a float64 network of random weights, whitening included."""
    rng = np.random.default_rng(seed)
    net = initialise(architecture, p, rng, paper_initialisation=True)
    Q, _ = np.linalg.qr(rng.standard_normal((p, p)))
    L = torch.from_numpy((Q * rng.uniform(0.2, 2, p)) @ Q.T)
    weights = {name: torch.from_numpy(w.astype(float)) for name, w in net.named_weights()}
    weights |= {"L": L, "L_inverse": torch.linalg.inv(L)}
    return Network.from_named_weights(architecture, weights)


def task(p: int, seed: int) -> tuple[Frames, torch.Tensor]:
    """Return a batch of frames with gaps, and known shapes."""
    generator = torch.Generator().manual_seed(seed)
    points, known, hidden = (
        torch.randn(*shape, generator=generator, dtype=torch.float64)
        for shape in ((5, p, 2), (4, p, 3), (5, p, 1))
    )
    mask = (hidden < 1).double()
    mask[:, :3] = 1
    return Frames(points * mask, mask), known - known.mean(1, keepdim=True)


def parts(net: Network, gradient: torch.Tensor) -> list[torch.Tensor]:
    """Return the gradient by each weight, in its shape."""
    weights = [weight for _, weight in net.trainable_weights()]
    bars = gradient.split([weight.numel() for weight in weights])
    return [bar.view(weight.shape) for bar, weight in zip(bars, weights, strict=True)]


@some
@given(
    widths,
    st.integers(4, 7),
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.0, 0.5]),
    st.sampled_from([0.0, 2.0]),
    st.booleans(),
    st.booleans(),
)
def test_it_is_the_gradient_that_torch_finds(
    widths: tuple[int, ...],
    p: int,
    seed: int,
    whitening: float,
    cycle: float,
    whitened: bool,
    known_object: bool,
) -> None:
    net = tensors(Architecture(widths, whitening=whitening), p, seed)
    layout = KeypointLayout(
        "thing",
        tuple("abcdefg"[:p]),
        edges=(("a", "b"), ("b", "c")),
        handedness=(("a", "b", "c", "d"),),
    )
    layout_loss = LayoutLoss(LayoutLossWeights(1.0, 1.0, 1.0), layout) if known_object else None
    objective = Objective(
        Normaliser(), Recipe(cycle=cycle), whitened=whitened, layout_loss=layout_loss
    )
    frames, known = task(p, seed)
    # The random numbers of both are the same, but torch draws them as it draws float32.
    torch.set_default_dtype(torch.float64)
    try:
        x = objective.task(net, frames, known, torch.Generator()).x
        size = torch.linalg.svdvals((encode(net, x)[-1] @ net.camera_head)[..., 0])
        if (size[:, 1] < 0.05 * size[:, 0]).any() or not size.all():
            return  # hardly a camera: its gradient is large, and torch's own not exact
        losses, gradient = GradientFunction(objective, net, 5)(
            net, frames, known, torch.Generator()
        )
        expected, by_torch = _by_torch(objective, net, frames, known, torch.Generator())
    finally:
        torch.set_default_dtype(torch.float32)
    for ours, theirs in zip(losses, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)
    bars = zip(net.trainable_weights(), parts(net, gradient), parts(net, by_torch), strict=True)
    for (name, weight), ours, theirs in bars:
        assert ours.shape == weight.shape
        torch.testing.assert_close(ours, theirs, rtol=1e-7, atol=1e-7, msg=name)


def test_every_option_has_a_gradient() -> None:
    objective = Objective(Normaliser(), Recipe())
    frames, known = (Frames(*(x.float() for x in task(5, 0)[0])), task(5, 0)[1].float())
    for options in (("block",), ("relu", "closed_form"), ("relu", "learned", "free")):
        net = tensors(Architecture((6, 4), *options), 5, 0).map(torch.Tensor.float)
        losses, gradient = GradientFunction(objective, net, 5)(
            net, frames, known, torch.Generator()
        )
        expected = objective(net, frames, known, torch.Generator())
        torch.testing.assert_close(losses.total, expected.total)
        heads = {"code_head", "camera_head"} if "closed_form" in options else set()
        for (name, weight), bar in zip(net.trainable_weights(), parts(net, gradient), strict=True):
            assert bar.shape == weight.shape and bool(bar.any()) == (name not in heads), name
            assert not weight.requires_grad


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
