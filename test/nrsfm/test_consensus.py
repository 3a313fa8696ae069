# SPDX-License-Identifier: Apache-2.0
"""Factorisations of few frames: their consensus is better than each, and chosen without truth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.data.synthetic_furniture import table
from deep_nrsfm_ros.nrsfm.factorisation import consensus as consensus_module
from deep_nrsfm_ros.nrsfm.factorisation.block_matrix import block_matrix
from deep_nrsfm_ros.nrsfm.factorisation.consensus import Consensus, consensus, image_scales
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


def test_rounds_come_closer_where_the_first_solutions_disagree() -> None:
    rng = np.random.default_rng(0)
    tables = centre(table(rng, 100))
    W = tables @ random_cameras(100, rng).astype(float)
    found = consensus(W)
    before = min(shape_errors(block_matrix(W, K), tables).proper for K in (3, 4))
    assert shape_errors(found.shapes, tables).proper < 0.2 * before
    assert 0.02 < found.spread < MAX_SPREAD


def test_scales_of_images_are_found_where_they_differ() -> None:
    _, W = images(2, noise=0.005)
    np.testing.assert_array_equal(image_scales(centre(W)), 1)
    scales = np.exp(np.random.default_rng(0).normal(0, 0.3, len(W)))
    found = image_scales(centre(scales[:, None, None] * W))
    np.testing.assert_allclose(found / found.mean(), scales / scales.mean(), rtol=0.05)
