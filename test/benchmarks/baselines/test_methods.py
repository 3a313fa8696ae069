# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest

from benchmarks.baselines.alike import block_matrix_of_neighbours, dissimilarity, nearest
from benchmarks.baselines.methods import BATCH, block_matrix, em_ppca, rigid, shuffled_batches
from deep_nrsfm_ros.nrsfm.factorisation import em_ppca as em_module
from deep_nrsfm_ros.nrsfm.factorisation.em_ppca import em_ppca_by_likelihood
from deep_nrsfm_ros.nrsfm.geometry import align, centre, random_cameras
from deep_nrsfm_ros.nrsfm.metrics import shape_errors

Method = Callable[[np.ndarray], np.ndarray]
MODES = 2
DEFORMING = {
    "block matrix": partial(block_matrix, K=MODES + 1),  # the mean shape counts
    "EM-PPCA": partial(em_ppca, K=MODES, iterations=100),
}
RECOVERING = DEFORMING | {
    "weighted": partial(block_matrix, K=MODES + 1, weighted=True),
    "annealed": partial(em_ppca, K=MODES, annealed=True, iterations=100),
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


@pytest.mark.parametrize("method", RECOVERING.values(), ids=RECOVERING.keys())
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
    errors = shape_errors(method.func(points, **method.keywords | {"K": 20}), shapes)
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


def test_batches_cover_every_frame_once() -> None:
    batches = shuffled_batches(2 * BATCH + 100, np.random.default_rng(1))
    assert [len(batch) for batch in batches] == [550, 550]
    frames = np.concatenate(batches)
    assert sorted(frames) == list(range(1100)) and (frames != np.arange(1100)).any()


def test_few_frames_are_one_batch() -> None:
    assert [len(batch) for batch in shuffled_batches(10, np.random.default_rng(0))] == [10]


def test_views_of_one_rigid_object_look_alike_and_others_do_not() -> None:
    rigid_views, others = seen(0.0, frames=20), seen(0.0, frames=20, seed=1)
    frames = np.concatenate([rigid_views.points, others.points])
    distance = dissimilarity(frames[0], frames)
    assert distance[:20].max() < 1e-12 < 1e-3 < distance[20:].min()
    found = nearest(frames[:1], frames, 19)
    assert sorted(found[0]) == list(range(1, 20))  # not itself


def test_neighbours_solve_what_all_frames_together_cannot() -> None:
    # Three rigid objects: each image has views of its own object among the frames.
    parts = [seen(0.0, frames=30, seed=i) for i in range(3)]
    points = np.concatenate([part.points for part in parts])
    shapes = np.concatenate([part.shapes for part in parts])
    S = block_matrix_of_neighbours(points[::30], points, neighbours=20, K=1)
    assert shape_errors(S, shapes[::30]).shape < 1e-3
    assert shape_errors(block_matrix(points, 1), shapes).shape > 0.1


def test_mirror_test_turns_frames_that_are_mirrored_and_no_others(deforming: Seen) -> None:
    Y = deforming.points.swapaxes(1, 2)
    model = em_module.fit_from_rigid(deforming.points, MODES, iterations=40)
    wrong = np.arange(len(Y)) % 5 == 0
    mean = model.basis[0].T
    depth_negated = mean @ model.Q.swapaxes(1, 2) * [1, 1, -1]
    turned = align(np.broadcast_to(mean, depth_negated.shape), depth_negated).rotation
    Q = np.where(wrong[:, None, None], turned.swapaxes(1, 2), model.Q)
    assert np.abs(Q[wrong] - model.Q[wrong]).max((1, 2)).min() > 0.1
    found = em_module._mirror_test(Y, replace(model, Q=Q)).Q
    np.testing.assert_array_equal(found[~wrong], model.Q[~wrong])
    assert np.abs(found[wrong] - model.Q[wrong]).max() < 0.3


def test_the_likelier_run_counts(deforming: Seen) -> None:
    S = em_ppca_by_likelihood(deforming.points, MODES, iterations=60)
    assert shape_errors(S, deforming.shapes).unscaled < 0.01


def test_a_restart_counts_if_it_is_likelier(
    deforming: Seen, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = em_module._start

    def badly_first(
        Y: np.ndarray, K: int, rng: np.random.Generator | None = None
    ) -> em_module.LinearModel:
        model = start(Y, K)
        # Without a generator, the cameras of other frames.
        return model if rng is not None else replace(model, Q=model.Q[::-1])

    monkeypatch.setattr(em_module, "_start", badly_first)
    errors = [
        shape_errors(
            em_ppca_by_likelihood(deforming.points, MODES, iterations=3, starts=starts),
            deforming.shapes,
        ).shape
        for starts in (1, 2)
    ]
    assert errors[1] < 0.05 < errors[0]


def test_a_restart_disturbs_the_cameras(deforming: Seen) -> None:
    Y = deforming.points.swapaxes(1, 2)
    first, again = (em_module._start(Y, MODES, rng) for rng in (None, np.random.default_rng(0)))
    cosine = (np.trace(first.Q @ again.Q.swapaxes(1, 2), axis1=1, axis2=2) - 1) / 2
    assert 0.3 < np.arccos(np.clip(cosine, -1, 1)).mean() < 1.3
