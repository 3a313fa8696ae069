"""The compiled losses and gradient against the same written out in torch."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros import kernel
from deep_nrsfm_ros.kernel import _kernel
from deep_nrsfm_ros.layouts.presets import CMU31
from deep_nrsfm_ros.nrsfm.layout_loss import LayoutLoss
from deep_nrsfm_ros.nrsfm.losses import Objective, Task
from deep_nrsfm_ros.nrsfm.network import Architecture, Network, encode, initialise, whitening
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, LayoutLossWeights, Recipe
from deep_nrsfm_ros.training import gradient_function as gradient
from deep_nrsfm_ros.training.compiled_gradient import CompiledGradient, fits, torch_on_one_thread
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.gradient_function import written_out
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
        torch.randn(*shape, generator=generator) for shape in ((b + c, p, 2), (b, p, 2), (c, p, 3))
    )
    mask = (torch.rand((b, p, 1), generator=generator) >= missing).float()
    return Task(x, W * mask, mask, T if c else None)


def in_double(net: Network, task: Task) -> tuple[Network, Task]:
    """Return both as float64."""
    parts = (None if part is None else part.double() for part in task)
    return net.map(torch.Tensor.double), Task(*parts)  # type: ignore[arg-type]


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    widths=st.lists(st.integers(1, 60), min_size=1, max_size=4).map(tuple),
    p=st.integers(1, 35),
    frames=st.tuples(st.integers(1, 70), st.integers(0, 70)),
    missing=st.sampled_from([0.0, 0.3, 1.0]),
    exponent=st.sampled_from([0.0, 1.0]),
    cycle=st.sampled_from([0.0, 2.0]),
    at_once=st.integers(1, 5),
    seed=st.integers(0, 2**32 - 1),
)
def test_it_is_what_torch_finds(
    widths: tuple[int, ...],
    p: int,
    frames: tuple[int, int],
    missing: float,
    exponent: float,
    cycle: float,
    at_once: int,
    seed: int,
    vectors: None,
) -> None:
    net, task = network(widths, p, exponent, seed), random_task(p, *frames, missing, seed)
    objective = Objective(Normaliser(), Recipe(cycle=cycle))
    torch.set_num_threads(at_once)
    assert fits(objective, net)
    weights = gradient.joined(w for _, w in net.trainable_weights())
    losses, found = CompiledGradient(objective, net, frames[0])(weights, task)
    expected, exact = written_out(objective, *in_double(net, task))
    size = torch.linalg.svdvals((encode(net, task.x)[-1] @ net.camera_head)[..., 0])
    if (size[:, 1] < 1e-3 * size[:, 0]).any():
        return  # no camera: any finite gradient will do, see `polar_gradient`
    # Where the last digits of the input matter, no more can be asked of the last of the output.
    generator = torch.Generator().manual_seed(seed)
    noise = (1 + 1e-6 * torch.randn(task.x.shape, generator=generator) for _ in range(5))
    moved = (in_double(net, task._replace(x=task.x * factor)) for factor in noise)
    nearby = [written_out(objective, *near) for near in moved]

    def check(ours: torch.Tensor, theirs: torch.Tensor, near: list[torch.Tensor]) -> None:
        unsure = max(float((other - theirs).norm()) for other in near)
        assert (ours - theirs).norm() <= 1e-4 * theirs.norm() + 10 * unsure + 1e-6

    for i, (ours, theirs) in enumerate(zip(losses, expected, strict=True)):
        check(ours, theirs, [other[i] for other, _ in nearby])
    check(found, exact, [other for _, other in nearby])


@pytest.mark.parametrize("name", ["default", "paper"])
@pytest.mark.parametrize("gaps", [False, True])
def test_a_training_goes_the_same_way_without(
    name: str, gaps: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    points = rng.standard_normal((50, len(CMU31), 2)).astype(np.float32)
    visible = rng.random((50, len(CMU31))) < (0.8 if gaps else 1)
    preset = PRESETS[name]
    recipe = dataclasses.replace(preset.recipe, batch=8, noise=0.1, mask=0.2 if gaps else 0.0)

    def trained() -> Trainer:
        trainer = Trainer(FrameStore.of(points, visible), preset._replace(recipe=recipe), 0)
        for _ in range(6):
            trainer.advance()
        return trainer

    ours = trained()
    asked: list[Task] = []

    def watched(objective: Objective, net: Network, task: Task) -> object:
        asked.append(task)
        return written_out(objective, net, task)

    monkeypatch.setattr(gradient, "written_out", watched)
    assert ours.descent(ours.net, ours.sample(8), None, ours.generator) and not asked
    monkeypatch.setattr(kernel, "AVAILABLE", False)
    theirs = trained()
    assert len(asked) == 6
    moved = (
        theirs.weights - gradient.joined(w for _, w in theirs.initial.trainable_weights())
    ).norm()
    assert (ours.weights - theirs.weights).norm() < 0.02 * moved


def test_what_it_does_not_know_is_left_to_torch() -> None:
    net, objective = network((8, 4), 31, 1.0, 0), Objective(Normaliser(), Recipe())
    assert fits(objective, net)
    assert not fits(objective, net.map(torch.Tensor.double))
    assert not fits(objective, net.map(lambda w: w.to("meta")))
    assert not fits(Objective(Normaliser(), Recipe(), whitened=False), net)
    known = LayoutLoss(LayoutLossWeights(bone_length_weight=1.0), CMU31)
    assert not fits(Objective(Normaliser(), Recipe(), layout_loss=known), net)
    unusual = dataclasses.replace(net, architecture=Architecture((8, 4), "block"))
    assert not fits(objective, unusual)


def test_torch_has_its_threads_again() -> None:
    torch.set_num_threads(2)

    def fail() -> None:
        with torch_on_one_thread():
            assert torch.get_num_threads() == 1
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert torch.get_num_threads() == 2


def test_arrays_that_do_not_fit_are_refused() -> None:
    net, objective = network((8, 4), 5, 1.0, 0), Objective(Normaliser(), Recipe())
    weights = gradient.joined(w for _, w in net.trainable_weights())
    compiled_gradient, task = CompiledGradient(objective, net, 3), random_task(5, 3, 2, 0.0, 0)
    for given_weights, given_task in (
        (weights[1:], task),
        (weights, task._replace(T=None)),
        (weights, task._replace(mask=task.mask[1:])),
        (weights, random_task(6, 3, 2, 0.0, 0)),
        (weights, random_task(5, 0, 0, 0.0, 0)),
    ):
        with pytest.raises(ValueError, match="do not fit the network"):
            compiled_gradient(given_weights, given_task)
    eye = np.eye(5, dtype=np.float32)
    for header in (
        [5, 2, 1, 16, 1, 8],
        [5, 1, 1, 0, 1, 8],
        [5, 1, 1, 16, 0, 8],
        [0, 1, 1, 16, 1, 8],
    ):
        with pytest.raises(ValueError, match="not those of a network"):
            _kernel.workers(np.array(header, np.int32), eye, eye)
    with pytest.raises(ValueError, match="not those of a network"):
        _kernel.workers(np.array([5, 1, 1, 16, 1, 8], np.int32), eye[1:], eye)
    assert _kernel.workers(np.array([5, 1, 1, 16, 1, 8], np.int32), eye, eye)


@pytest.mark.parametrize("exponent", [0.0, 1.0])
@pytest.mark.parametrize("name", ["D.0", "D.1", "b.0", "b_.1", "code_head", "input"])
def test_what_is_no_number_shows_and_is_gone_with_its_cause(
    exponent: float, name: str, vectors: None
) -> None:
    net, objective = network((8, 4), 5, exponent, 0), Objective(Normaliser(), Recipe())
    gradient_of, task = CompiledGradient(objective, net, 3), random_task(5, 3, 2, 0.0, 0)
    weights, nan = gradient.joined(w for _, w in net.trainable_weights()), float("nan")
    before, grad = gradient_of(weights, task)
    parts = {key: w * nan if key == name else w for key, w in net.trainable_weights()}
    seen = task._replace(x=task.x * nan, W=task.W * nan) if name == "input" else task
    losses, _ = gradient_of(gradient.joined(parts.values()), seen)
    assert losses.total.isnan()
    after, again = gradient_of(weights, task)
    assert torch.equal(after.total, before.total) and torch.equal(again, grad)


def test_wide_and_deep_networks_are_left_to_torch() -> None:
    objective = Objective(Normaliser(), Recipe())
    assert fits(objective, network((512, 256), 31, 1.0, 0))
    assert not fits(objective, network((1024,), 31, 1.0, 0))
    most = _kernel.MOST_LAYERS
    assert fits(objective, network((2,) * most, 5, 1.0, 0))
    assert not fits(objective, network((2,) * (most + 1), 5, 1.0, 0))
