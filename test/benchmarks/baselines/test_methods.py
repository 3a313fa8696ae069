from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest

from benchmarks.baselines.methods import BATCH, block_matrix, em_ppca, in_batches, rigid
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras
from deep_nrsfm_ros.nrsfm.metrics import shape_errors

Method = Callable[[np.ndarray], np.ndarray]
MODES = 2
DEFORMING = {
    "block matrix": partial(block_matrix, K=MODES + 1),  # the mean shape counts
    "EM-PPCA": partial(em_ppca, K=MODES),
}


class Seen(NamedTuple):
    shapes: np.ndarray  # (f, 20, 3)
    points: np.ndarray  # (f, 20, 2)


def seen(deformation: float, frames: int = 150, noise: float = 0.0, seed: int = 0) -> Seen:
    """An object of 20 points, its codes Gaussian, each frame from a random camera."""
    rng = np.random.default_rng(seed)
    mean, modes = rng.standard_normal((20, 3)), rng.standard_normal((MODES, 20, 3))
    codes = deformation * rng.standard_normal((frames, MODES))
    shapes = centre(mean + np.einsum("fk,kpd->fpd", codes, modes))
    points = shapes @ random_cameras(frames, rng).astype(float)
    return Seen(shapes, points + noise * centre(rng.standard_normal(points.shape)))


@pytest.fixture(scope="module")
def deforming() -> Seen:
    return seen(0.3)


@pytest.mark.parametrize("seed", range(3))
def test_rigid_factorisation_is_exact_on_a_rigid_object(seed: int) -> None:
    shapes, points = seen(0.0, seed=seed)
    assert shape_errors(rigid(points), shapes).unscaled < 1e-6


def test_rigid_factorisation_gives_every_frame_the_same_shape(deforming: Seen) -> None:
    S = rigid(deforming.points)
    assert S.shape == deforming.shapes.shape
    assert np.ptp(S, axis=0).max() == 0
    assert shape_errors(S, deforming.shapes).shape > 0.2


@pytest.mark.parametrize("method", DEFORMING.values(), ids=DEFORMING.keys())
def test_methods_for_deforming_objects_recover_one_that_is_of_their_rank(
    method: Method, deforming: Seen
) -> None:
    errors = shape_errors(method(deforming.points), deforming.shapes)
    assert errors.unscaled < 0.01
    assert errors.mirrored == 0


@pytest.mark.parametrize("method", DEFORMING.values(), ids=DEFORMING.keys())
def test_methods_for_deforming_objects_bear_noise(method: Method) -> None:
    shapes, points = seen(0.3, noise=0.05)
    assert shape_errors(method(points), shapes).proper < 0.12


@pytest.mark.parametrize("method", DEFORMING.values(), ids=DEFORMING.keys())
def test_methods_for_deforming_objects_take_a_rank_beyond_that_of_the_images(
    method: partial[np.ndarray],
) -> None:
    shapes, points = seen(0.0, frames=30)
    errors = shape_errors(method.func(points, 20), shapes)
    assert errors.shape < 0.01


@pytest.mark.parametrize("method", [rigid, *DEFORMING.values()], ids=["rigid", *DEFORMING])
def test_one_object_frame_serves_all_frames(method: Method, deforming: Seen) -> None:
    # One camera for each frame must explain it: the mean over frames is near the mean shape.
    mean = deforming.shapes.mean(0)
    S = method(deforming.points).mean(0)
    assert shape_errors(S[None], mean[None]).shape < 0.1


@pytest.mark.parametrize("method", [rigid, *DEFORMING.values()], ids=["rigid", *DEFORMING])
def test_the_order_of_the_frames_does_not_matter(method: Method, deforming: Seen) -> None:
    order = np.random.default_rng(1).permutation(len(deforming.points))
    S, shuffled = method(deforming.points), method(deforming.points[order])
    assert shape_errors(shuffled, S[order]).shape < 1e-3


def test_batches_cover_every_frame_once_and_say_which() -> None:
    points = np.random.default_rng(0).standard_normal((2 * BATCH + 100, 4, 2))
    sizes = []

    def flat(W: np.ndarray) -> np.ndarray:
        sizes.append(len(W))
        return np.concatenate([W, np.zeros((*W.shape[:2], 1))], -1)

    S, frames = in_batches(flat, points, np.random.default_rng(1))
    assert sizes == [550, 550]
    assert sorted(frames) == list(range(len(points)))
    assert (frames != np.arange(len(points))).any()
    np.testing.assert_array_equal(S[..., :2], points[frames])


def test_few_frames_are_one_batch() -> None:
    S, frames = in_batches(rigid, seen(0.0, frames=10).points, np.random.default_rng(0))
    assert len(S) == len(frames) == 10
