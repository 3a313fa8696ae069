# SPDX-License-Identifier: Apache-2.0
"""The compiled network against torch's autograd through `network.py`, in float64."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros import kernel
from deep_nrsfm_ros.kernel import _kernel
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import CMU31
from deep_nrsfm_ros.nrsfm.layout_loss import LayoutLoss
from deep_nrsfm_ros.nrsfm.losses import Losses, Objective, Task
from deep_nrsfm_ros.nrsfm.network import (
    Architecture,
    Network,
    encode,
    forward,
    initialise,
    whitening,
)
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, LayoutLossWeights, Recipe
from deep_nrsfm_ros.training.compiled_network import (
    CompiledNetwork,
    supports,
    torch_on_one_thread,
)
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.gradient_function import weight_vector, with_weights
from deep_nrsfm_ros.training.trainer import Trainer


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    """Leave torch as many threads as it had."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def network(widths: tuple[int, ...], p: int, exponent: float, seed: int) -> Network:
    """Return a float32 network of random weights, biases included."""
    rng = np.random.default_rng(seed)
    net = initialise(Architecture(widths, whitening=exponent), p, rng, paper_initialisation=True)
    A = rng.standard_normal((p, p))
    L, L_inverse = whitening(A @ A.T + np.eye(p), exponent, 1e-2)
    return dataclasses.replace(net, L=L, L_inverse=L_inverse).map(torch.from_numpy)


def random_task(p: int, b: int, c: int, missing: float, seed: int) -> Task:
    """Return a task of b frames and c known shapes."""
    generator = torch.Generator().manual_seed(seed)
    x, W, T = (
        torch.randn(*shape, generator=generator) for shape in ((b + c, p, 2), (b, 2, p), (c, 3, p))
    )
    mask = (torch.rand((b, 1, p), generator=generator) >= missing).float()
    return Task(x, W * mask, mask if missing else None, T if c else None)


def layout(p: int) -> KeypointLayout:
    """Return a layout of p keypoints with two edges and a handedness."""
    names = tuple(f"k{i}" for i in range(p))
    edges = ((names[0], names[1]), (names[1], names[2]))
    corners = (names[0], names[1], names[2], names[3])
    return KeypointLayout("thing", names, edges=edges, handedness=(corners,))


def by_autograd(objective: Objective, net: Network, task: Task) -> list[torch.Tensor]:
    """Return losses and gradient through `network.py`, in float64."""
    double = net.map(torch.Tensor.double)
    parts = (None if part is None else part.double() for part in task)
    task = Task(*parts)  # type: ignore[arg-type]
    weights = weight_vector(double).requires_grad_()
    losses = objective.losses(double, task, *forward(with_weights(double, weights), task.x))
    return _detached(losses, weights)


def compiled(objective: Objective, net: Network, task: Task) -> list[torch.Tensor]:
    """Return losses and gradient through the compiled network."""
    weights = weight_vector(net).requires_grad_()
    losses = objective.losses(net, task, *CompiledNetwork(net, len(task.W))(weights, task.x))
    return _detached(losses, weights)


def _detached(losses: Losses, weights: torch.Tensor) -> list[torch.Tensor]:
    """Return the losses and the gradient of their total."""
    (gradient,) = torch.autograd.grad(losses.total, weights)
    return [*(loss.detach() for loss in losses), gradient]


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    widths=st.lists(st.integers(1, 60), min_size=1, max_size=4).map(tuple),
    p=st.integers(4, 35),
    sizes=st.tuples(st.integers(1, 70), st.integers(0, 70)),
    missing=st.sampled_from([0.0, 0.3, 1.0]),
    exponent=st.sampled_from([0.0, 1.0]),
    layout_weight=st.sampled_from([0.0, 0.5]),
    at_once=st.integers(1, 5),
    seed=st.integers(0, 2**32 - 1),
)
def test_it_has_the_losses_and_the_gradient_of_autograd(
    widths: tuple[int, ...],
    p: int,
    sizes: tuple[int, int],
    missing: float,
    exponent: float,
    layout_weight: float,
    at_once: int,
    seed: int,
    vectors: None,
) -> None:
    net, task = network(widths, p, exponent, seed), random_task(p, *sizes, missing, seed)
    size = torch.linalg.svdvals((encode(net, task.x)[-1] @ net.camera_head)[..., 0])
    # Without a camera any finite gradient will do, see `polar`.
    assume(bool((size[:, 1] >= 1e-3 * size[:, 0]).all()))
    weights = LayoutLossWeights(layout_weight, layout_weight, layout_weight)
    layout_loss = LayoutLoss(weights, layout(p)) if layout_weight else None
    objective = Objective(Normaliser(), Recipe(), layout_loss=layout_loss)
    torch.set_num_threads(at_once)
    assert supports(net)
    ours, exact = compiled(objective, net, task), by_autograd(objective, net, task)

    @cache
    def nearby() -> list[list[torch.Tensor]]:
        """Return the exact results of inputs that differ in their last digits.

        They are many: an atom at its threshold is switched by the last digit of few of them, and
        the gradient jumps there.
        """
        generator = torch.Generator().manual_seed(seed)
        noise = (1 + 1e-6 * torch.randn(task.x.shape, generator=generator) for _ in range(50))
        return [by_autograd(objective, net, task._replace(x=task.x * factor)) for factor in noise]

    for i, (found, wanted) in enumerate(zip(ours, exact, strict=True)):
        error = float((found - wanted).norm())
        close = 1e-4 * float(wanted.norm()) + 1e-6
        if not error <= close:  # float32 cannot be more exact than these results are alike
            assert error <= close + 10 * max(float((near[i] - wanted).norm()) for near in nearby())


@pytest.mark.parametrize("name", ["default", "paper"])
@pytest.mark.parametrize("gaps", [False, True])
def test_a_training_without_the_kernel_goes_the_same_way(
    name: str, gaps: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    points = rng.standard_normal((50, len(CMU31), 2)).astype(np.float32)
    visible = rng.random((50, len(CMU31))) < (0.8 if gaps else 1)
    preset = PRESETS[name]
    recipe = dataclasses.replace(preset.recipe, batch=8, added_noise=0.1, mask=0.2 if gaps else 0.0)

    def trained() -> Trainer:
        trainer = Trainer(FrameStore.of(points, visible), preset._replace(recipe=recipe), 0)
        for _ in range(6):
            trainer.advance()
        return trainer

    ours = trained()
    assert ours.gradient_function.compiled
    monkeypatch.setattr(kernel, "AVAILABLE", False)
    theirs = trained()
    assert not theirs.gradient_function.compiled
    moved = (theirs.weights - weight_vector(theirs.initial)).norm()
    assert (ours.weights - theirs.weights).norm() < 0.02 * moved


def test_calls_do_not_disturb_each_other() -> None:
    nets = [network((8, 4), 5, 1.0, seed) for seed in (0, 1)]
    xs = [random_task(5, b, 0, 0.0, b).x for b in (3, 20)]
    function = CompiledNetwork(nets[0], 20)

    def gradients(together: bool) -> list[torch.Tensor]:
        calls = []
        found: list[torch.Tensor] = []
        for net, x in zip(nets, xs, strict=True):
            weights = weight_vector(dataclasses.replace(net, L=nets[0].L)).requires_grad_()
            S, M = function(weights, x)
            calls.append((S.sum() + M.sum(), weights))
            if not together:
                found += torch.autograd.grad(*calls.pop())
        return found + [torch.autograd.grad(*call)[0] for call in calls]

    for apart, mixed in zip(gradients(False), gradients(True), strict=True):
        assert torch.equal(apart, mixed) and apart.any()


def test_one_thread_of_python_at_a_time() -> None:
    net = network((256, 128), 31, 1.0, 0)
    function, weights = CompiledNetwork(net, 64), weight_vector(net)
    x = random_task(31, 4000, 0, 0.0, 0).x
    refused: list[str] = []

    def call() -> None:
        for _ in range(5):
            try:
                function(weights, x)
            except RuntimeError as error:
                refused.append(str(error))

    callers = [threading.Thread(target=call) for _ in range(4)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert set(refused) == {"the workers are in use by another call"}
    assert function(weights, x)


def test_what_the_kernel_does_not_support_is_torchs() -> None:
    net = network((8, 4), 31, 1.0, 0)
    assert supports(net)
    assert not supports(net.map(torch.Tensor.double))
    assert not supports(net.map(lambda w: w.to("meta")))
    for options in (("block",), ("relu", "closed_form"), ("relu", "learned", "free")):
        architecture = Architecture((8, 4), *options)
        assert not supports(dataclasses.replace(net, architecture=architecture))


def test_wide_and_deep_networks_are_torchs() -> None:
    assert supports(network((512, 256), 31, 1.0, 0))
    assert not supports(network((1024,), 31, 1.0, 0))
    most = _kernel.MAX_LAYERS
    assert supports(network((2,) * most, 5, 1.0, 0))
    assert not supports(network((2,) * (most + 1), 5, 1.0, 0))


def test_torch_has_its_threads_again() -> None:
    torch.set_num_threads(2)

    def fail() -> None:
        with torch_on_one_thread():
            assert torch.get_num_threads() == 1
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize("wrong", range(5))
@pytest.mark.parametrize("length", ["longer", "shorter", "empty"])
def test_arrays_that_do_not_fit_are_refused(wrong: int, length: str) -> None:
    net = network((8, 4), 5, 1.0, 0)
    pool = CompiledNetwork(net, 3).pool
    weights, kept = weight_vector(net).numpy(), _kernel.activations_per_frame(pool)
    calls = {
        _kernel.network_forward: [weights, *map(zeros, (30, 3 * kept, 45, 18))],
        _kernel.network_backward: [weights, *map(zeros, (3 * kept, 45, 18, len(weights)))],
    }
    change = {
        "longer": lambda array: np.concatenate([array, array]),
        "shorter": lambda array: array[:-1].copy(),
        "empty": lambda array: array[:0].copy(),
    }[length]
    for call, arrays in calls.items():
        call(pool, *arrays)
        arrays[wrong] = change(arrays[wrong])
        with pytest.raises(ValueError, match="do not fit the network"):
            call(pool, *arrays)
        with pytest.raises(ValueError, match="PyCapsule"):
            call(object(), *arrays)


def zeros(n: int) -> np.ndarray:
    return np.zeros(n, np.float32)


@pytest.mark.parametrize(
    "header",
    [
        *([], [5], [5, 2, 1, 16, 1, 8], [5, 1, 1, 0, 1, 8], [5, 1, 1, 16, 0, 8]),
        *([0, 1, 1, 16, 1, 8], [5, 0, 1, 16, 1], [5, 1, 1, 16, 1, 0], [5, 1, 1, 16, 1, -8]),
        *([5, 1, 1, 2**30, 1, 8], [5, 1, 1, 16, 2**30, 8], [5, 1, 1, 16, 1, 2**31 - 1]),
        *([2**31 - 1, 1, 1, 16, 1, 8], [-5, 1, 1, 16, 1, 8], [5, 10**6, 1, 16, 1, 8]),
    ],
)
def test_a_header_out_of_range_is_refused(header: list[int]) -> None:
    eye = np.eye(5, dtype=np.float32)
    with pytest.raises(ValueError, match="not those of a network"):
        _kernel.worker_pool(np.array(header, np.int32), eye, eye)


def test_a_whitening_of_another_size_is_refused() -> None:
    eye, header = np.eye(5, dtype=np.float32), np.array([5, 1, 1, 16, 1, 8], np.int32)
    for whitenings in ((eye[1:], eye), (eye, eye[1:])):
        with pytest.raises(ValueError, match="not those of a network"):
            _kernel.worker_pool(header, *whitenings)
    assert _kernel.worker_pool(header, eye, eye)


@pytest.mark.parametrize("exponent", [0.0, 1.0])
@pytest.mark.parametrize("name", ["D.0", "D.1", "b.0", "b_.1", "code_head", "input"])
def test_nan_shows_and_does_not_stay(exponent: float, name: str, vectors: None) -> None:
    net, task = network((8, 4), 5, exponent, 0), random_task(5, 3, 0, 0.0, 0)
    function, nan = CompiledNetwork(net, 3), float("nan")

    def call(weights: torch.Tensor, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        weights = weights.detach().requires_grad_()
        S, M = function(weights, x)
        return S, torch.autograd.grad((S * S).sum() + M.sum(), weights)[0]

    weights = weight_vector(net)
    S, gradient = call(weights, task.x)
    parts = [(w * nan if key == name else w).flatten() for key, w in net.trainable_weights()]
    broken, _ = call(torch.cat(parts), task.x * nan if name == "input" else task.x)
    assert broken.isnan().any()
    S_after, gradient_after = call(weights, task.x)
    assert torch.equal(S_after, S) and torch.equal(gradient_after, gradient)
