# SPDX-License-Identifier: Apache-2.0
"""Factorisations of few frames: their consensus is better than each, and chosen without truth."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
import pytest

from benchmarks.data.synthetic_furniture import table
from deep_nrsfm_ros.nrsfm.factorisation import consensus as consensus_module
from deep_nrsfm_ros.nrsfm.factorisation.block_matrix import block_matrix
from deep_nrsfm_ros.nrsfm.factorisation.consensus import (
    Consensus,
    consensus,
    image_scales,
    seconds_at_most,
)
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras
from deep_nrsfm_ros.nrsfm.metrics import shape_errors
from deep_nrsfm_ros.training.few_frames import MAX_SPREAD


def images(modes: int, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return shapes (60, 14, 3) of Gaussian modes that grow smaller, and an image of each."""
    rng = np.random.default_rng(modes)
    mean, basis = rng.standard_normal((14, 3)), rng.standard_normal((modes, 14, 3))
    codes = rng.standard_normal((60, modes)) * 0.2 / (1 + np.arange(modes))
    shapes = centre(mean + np.einsum("fk,kpd->fpd", codes, basis))
    W = shapes @ random_cameras(60, rng).astype(float)
    return shapes, W + noise * rng.standard_normal(W.shape)


Solved = tuple[np.ndarray, np.ndarray, Consensus]


@pytest.fixture(scope="module")
def agreeing() -> list[Any]:
    """Return the list of the solutions that agree, which the fixture `noisy` fills."""
    return []


@pytest.fixture(scope="module")
def noisy(agreeing: list[Any]) -> Solved:
    shapes, W = images(5, noise=0.02)
    with pytest.MonkeyPatch.context() as patch:
        kept = consensus_module._agreeing
        patch.setattr(
            consensus_module, "_agreeing", lambda *args: agreeing.extend(kept(*args)) or agreeing
        )
        return shapes, W, consensus(W)


def test_the_consensus_is_better_than_the_block_matrix_method(
    noisy: Solved,
) -> None:
    shapes, W, found = noisy
    single = min(shape_errors(block_matrix(W, K), shapes).proper for K in (2, 3))
    assert shape_errors(found.shapes, shapes).proper < single
    assert found.solutions > 1
    assert 0 < found.spread < 0.1


def test_solutions_that_start_from_the_mean_improve_it(noisy: Solved, agreeing: list[Any]) -> None:
    shapes, W, found = noisy
    first = consensus_module._mean(centre(W), agreeing)
    assert found.solutions > len(agreeing)
    assert shape_errors(found.shapes, shapes).proper < shape_errors(first.seen, shapes).proper


def test_shapes_and_rotations_give_the_images(
    noisy: Solved,
) -> None:
    _, W, found = noisy
    seen = found.shapes @ found.rotations.swapaxes(1, 2)
    np.testing.assert_allclose(seen[..., :2], centre(W), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(found.rotations), 1)


def test_few_modes_without_noise_are_found_exactly() -> None:
    shapes, W = images(2)
    found = consensus(W)
    assert found.solutions == 1
    assert found.spread == pytest.approx(0)  # one solution alone agrees with itself
    assert shape_errors(found.shapes, shapes).proper < 0.01


def test_images_without_a_common_shape_have_no_agreement() -> None:
    W = np.random.default_rng(0).standard_normal((30, 10, 2))
    assert consensus(W).spread > MAX_SPREAD


class Rounds(NamedTuple):
    """Tables whose first solutions disagree, and the way to their consensus."""

    shapes: np.ndarray
    W: np.ndarray
    results: list[Consensus]
    iterations: int


@pytest.fixture(scope="module")
def rounds() -> Rounds:
    rng = np.random.default_rng(0)
    shapes = centre(table(rng, 100))
    W = shapes @ random_cameras(100, rng).astype(float)
    results: list[Consensus] = []
    iterations: list[None] = []
    found = consensus(W, lambda: iterations.append(None), results.append)
    assert found is results[-1]
    return Rounds(shapes, W, results, len(iterations))


def test_rounds_come_closer_where_the_first_solutions_disagree(rounds: Rounds) -> None:
    found = rounds.results[-1]
    before = min(shape_errors(block_matrix(rounds.W, K), rounds.shapes).proper for K in (3, 4))
    assert shape_errors(found.shapes, rounds.shapes).proper < 0.2 * before
    assert 0.02 < found.spread < MAX_SPREAD


def test_results_on_the_way_are_of_use(rounds: Rounds) -> None:
    errors = [shape_errors(each.shapes, rounds.shapes).proper for each in rounds.results]
    assert len(errors) == 5
    assert errors[-1] == min(errors) < 0.5 * errors[0] < 0.2
    assert all(each.spread < MAX_SPREAD for each in rounds.results)


def test_iterations_are_foretold(rounds: Rounds, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(consensus_module, "_seconds_of_one", lambda *_: 1.0)
    assert rounds.iterations <= seconds_at_most(rounds.W) < 1.7 * rounds.iterations


def test_the_first_result_of_images_without_a_common_shape_has_no_agreement() -> None:
    results: list[Consensus] = []
    consensus(np.random.default_rng(0).standard_normal((30, 10, 2)), on_result=results.append)
    assert results[0].spread > MAX_SPREAD


def test_the_seconds_are_those_of_timed_iterations() -> None:
    _, W = images(5, noise=0.02)
    iterations: list[int] = []
    assert 0 < seconds_at_most(W, lambda: iterations.append(0)) < 60
    assert len(iterations) < 100
    assert seconds_at_most(W, lambda: time.sleep(0.01)) > 40


def test_scales_of_images_are_found_where_they_differ() -> None:
    _, W = images(2, noise=0.005)
    np.testing.assert_array_equal(image_scales(centre(W)), 1)
    scales = np.exp(np.random.default_rng(0).normal(0, 0.3, len(W)))
    found = image_scales(centre(scales[:, None, None] * W))
    np.testing.assert_allclose(found / found.mean(), scales / scales.mean(), rtol=0.05)
