"""The compiled losses and gradient against the same written out in torch."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros.nrsfm import _kernel, compiled, gradient
from deep_nrsfm_ros.nrsfm.anatomy import AnatomyLoss
from deep_nrsfm_ros.nrsfm.compiled_gradient import CompiledGradient, fits, torch_on_one_thread
from deep_nrsfm_ros.nrsfm.gradient import written_out
from deep_nrsfm_ros.nrsfm.keypoints import CMU31
from deep_nrsfm_ros.nrsfm.losses import Objective, Task
from deep_nrsfm_ros.nrsfm.network import Architecture, Network, initialise, whitening
from deep_nrsfm_ros.nrsfm.normaliser import Normaliser
from deep_nrsfm_ros.nrsfm.pool import Pool
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, Anatomy, Recipe
from deep_nrsfm_ros.nrsfm.trainer import Trainer


@pytest.fixture(params=[16, 32, 64])
def vectors(request: pytest.FixtureRequest) -> Iterator[None]:
    """Try vectors of all lengths, as far as the processor has them."""
    if _kernel.choose_vectors(request.param) != request.param:
        pytest.skip(f"this processor has no vectors of {request.param} bytes")
    yield
    _kernel.choose_vectors(64)


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    """Leave torch as many threads as it had."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def network(widths: tuple[int, ...], p: int, exponent: float, seed: int) -> Network:
    """Return a float32 network of random weights, biases included."""
    rng = np.random.default_rng(seed)
    net = initialise(Architecture(widths, whitening=exponent), p, rng, as_released=True)
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
    widths=st.lists(st.integers(1, 40), min_size=1, max_size=4).map(tuple),
    p=st.integers(3, 35),
    frames=st.tuples(st.integers(1, 70), st.integers(0, 70)),
    missing=st.sampled_from([0.0, 0.3, 1.0]),
    exponent=st.sampled_from([0.0, 1.0]),
    cycle=st.sampled_from([0.0, 2.0]),
    at_once=st.integers(1, 3),
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
    weights = gradient.joined(w for _, w in net.learned())
    losses, found = CompiledGradient(objective, net)(weights, task)
    expected, exact = written_out(objective, *in_double(net, task))
    # No more can be asked of single precision than torch gets by it.
    _, by_torch = written_out(objective, net, task)
    for name, ours, theirs in zip(losses._fields, losses, expected, strict=True):
        size = max(1.0, float(theirs.abs().max()))
        torch.testing.assert_close(
            ours, theirs.float(), rtol=0, atol=1e-4 * size, msg=lambda text, n=name: f"{n}: {text}"
        )
    ours, theirs = ((grad - exact).norm() for grad in (found, by_torch))
    assert ours <= 3 * theirs + 1e-5 * exact.norm() + 1e-9


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
        trainer = Trainer(Pool.of(points, visible), preset._replace(recipe=recipe), 0)
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
    monkeypatch.setattr(compiled, "AVAILABLE", False)
    theirs = trained()
    assert len(asked) == 6
    moved = (theirs.weights - gradient.joined(w for _, w in theirs.initial.learned())).norm()
    assert (ours.weights - theirs.weights).norm() < 0.02 * moved


def test_what_it_does_not_know_is_left_to_torch() -> None:
    net, objective = network((8, 4), 31, 1.0, 0), Objective(Normaliser(), Recipe())
    assert fits(objective, net)
    assert not fits(objective, net.map(torch.Tensor.double))
    assert not fits(objective, net.map(lambda w: w.to("meta")))
    assert not fits(Objective(Normaliser(), Recipe(), whitened=False), net)
    known = AnatomyLoss(Anatomy(bones=1.0), CMU31)
    assert not fits(Objective(Normaliser(), Recipe(), anatomy=known), net)
    unusual = dataclasses.replace(net, architecture=Architecture((8, 4), "block"))
    assert not fits(objective, unusual)


def test_torch_has_its_threads_again() -> None:
    torch.set_num_threads(2)
    with pytest.raises(KeyError), torch_on_one_thread():
        assert torch.get_num_threads() == 1
        raise KeyError
    assert torch.get_num_threads() == 2


def test_arrays_that_do_not_fit_are_refused() -> None:
    net, objective = network((8, 4), 5, 1.0, 0), Objective(Normaliser(), Recipe())
    weights = gradient.joined(w for _, w in net.learned())
    compiled_gradient, task = CompiledGradient(objective, net), random_task(5, 3, 2, 0.0, 0)
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
            _kernel.descent(np.array(header, np.int32), eye, eye)
    with pytest.raises(ValueError, match="not those of a network"):
        _kernel.descent(np.array([5, 1, 1, 16, 1, 8], np.int32), eye[1:], eye)
    assert _kernel.descent(np.array([5, 1, 1, 16, 1, 8], np.int32), eye, eye)
