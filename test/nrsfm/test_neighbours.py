# SPDX-License-Identifier: Apache-2.0
"""Mirrored frames are found without labels, a good model is left alone, gaps are bridged."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from deep_nrsfm_ros.nrsfm.geometry import align, centre, random_cameras
from deep_nrsfm_ros.nrsfm.neighbours import (
    Neighbours,
    Reference,
    join,
    mirrored_frames,
    nearest,
    rigid_shapes,
)
from deep_nrsfm_ros.nrsfm.network import whitening

P = 14


class Scene(NamedTuple):
    """A deforming object, its images, and the neighbours and reference made from the images."""

    shapes: np.ndarray
    W: np.ndarray
    pairs: Neighbours
    reference: Reference


def whitened(W: np.ndarray) -> np.ndarray:
    rows = W.swapaxes(1, 2).reshape(-1, W.shape[1])
    L, _ = whitening(rows.T @ rows / len(W), 1.0, 1e-3)
    return np.einsum("ij,njd->nid", L, W)


def make_scene(frames: int = 1500, modes: int = 2, seed: int = 0) -> Scene:
    rng = np.random.default_rng(seed)
    basis = rng.standard_normal((1 + modes, P, 3)) * np.array([1, *[0.4] * modes])[:, None, None]
    codes = np.concatenate([np.ones((frames, 1)), rng.uniform(-1, 1, (frames, modes))], 1)
    shapes = centre(np.einsum("fk,kpd->fpd", codes, basis))
    W = shapes @ random_cameras(frames, rng)
    pairs = nearest(whitened(W), 16)
    return Scene(shapes, W, pairs, join(rigid_shapes(W, pairs), pairs))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene()


def lifted(scene: Scene, mirrored: np.ndarray, noise: float = 0.1, seed: int = 1) -> np.ndarray:
    """Return the shapes as a network with an error would lift them, in axes of their own."""
    rng = np.random.default_rng(seed)
    size = np.sqrt((scene.shapes**2).mean((1, 2), keepdims=True))
    X = scene.shapes + noise * size * rng.standard_normal(scene.shapes.shape)
    axes = np.where(mirrored[:, None, None], np.diag([1.0, 1, -1]), np.eye(3))
    return X @ axes @ np.linalg.qr(rng.standard_normal((3, 3)))[0] * 0.3 + 5


ALL = np.ones((1500, P), bool)


def test_neighbours_show_nearly_the_same_shape(scene: Scene) -> None:
    def distance(others: np.ndarray) -> float:
        X, Y = scene.shapes, scene.shapes[others]
        difference = align(X, Y).aligned - Y
        return float(np.median(np.linalg.norm(difference, axis=(1, 2)) / np.linalg.norm(Y)))

    rng = np.random.default_rng(0)
    assert distance(scene.pairs.frames[:, 0]) < 0.2 * distance(rng.permutation(1500))
    assert (np.diff(scene.pairs.distances, axis=1) >= 0).all()
    assert (scene.pairs.frames != np.arange(1500)[:, None]).all()


def test_rigid_shapes_are_the_true_ones_up_to_reflection(scene: Scene) -> None:
    X = scene.reference.shapes
    truth = scene.shapes / np.linalg.norm(scene.shapes, axis=(1, 2), keepdims=True)
    errors = np.linalg.norm(align(X, truth, allow_reflection=True).aligned - truth, axis=(1, 2))
    assert np.median(errors) < 0.05


def test_the_reference_has_one_handedness(scene: Scene) -> None:
    turned = align(scene.reference.shapes, scene.shapes, allow_reflection=True).mirrored
    largest = scene.reference.parts == np.bincount(scene.reference.parts).argmax()
    assert largest.mean() > 0.9
    assert min(turned[largest].mean(), 1 - turned[largest].mean()) < 0.005


@pytest.mark.parametrize("share", [0.02, 0.4])
def test_mirrored_frames_are_found(scene: Scene, share: float) -> None:
    mirrored = np.random.default_rng(2).random(1500) < share
    test = mirrored_frames(lifted(scene, mirrored), ALL, scene.reference)
    assert (test.mirrored ^ mirrored).mean() < 0.01
    assert test.share == pytest.approx(mirrored.mean(), abs=0.01)


def test_a_mirrored_region_of_shapes_is_found(scene: Scene) -> None:
    # As a network fails: it mirrors all frames of some poses, in which most neighbours agree.
    mirrored = scene.shapes[:, 0, 0] > np.quantile(scene.shapes[:, 0, 0], 0.6)
    test = mirrored_frames(lifted(scene, mirrored), ALL, scene.reference)
    assert (test.mirrored ^ mirrored).mean() < 0.01


def test_a_good_model_is_left_alone(scene: Scene) -> None:
    for all_mirrored in (False, True):  # no image tells one from the other
        model = lifted(scene, np.full(1500, all_mirrored), noise=0.2)
        assert mirrored_frames(model, ALL, scene.reference).share < 0.002


def test_a_chance_result_is_no_good_model(scene: Scene) -> None:
    X = np.random.default_rng(3).standard_normal(scene.shapes.shape)
    assert mirrored_frames(X, ALL, scene.reference).share > 0.3


def test_missing_keypoints_do_not_vote(scene: Scene) -> None:
    rng = np.random.default_rng(4)
    mirrored, visible = rng.random(1500) < 0.3, rng.random(ALL.shape) > 0.3
    X = lifted(scene, mirrored)
    wild = np.where(visible[..., None], X, 100 * rng.standard_normal(X.shape))
    assert (mirrored_frames(wild, visible, scene.reference).mirrored ^ mirrored).mean() < 0.02
    assert (mirrored_frames(wild, ALL, scene.reference).mirrored ^ mirrored).mean() > 0.1


def test_one_view_says_nothing() -> None:
    rng = np.random.default_rng(5)
    shapes = centre(rng.standard_normal((1, P, 3)) + 1e-3 * rng.standard_normal((300, P, 3)))
    W = shapes[..., :2]
    pairs = nearest(whitened(W), 16)
    assert np.isinf(pairs.distances).mean() > 0.9
    test = mirrored_frames(shapes, np.ones((300, P), bool), join(rigid_shapes(W, pairs), pairs))
    assert test.tested.mean() < 0.1 and test.share == 0


@pytest.mark.parametrize("frames", [0, 1, 2, 3, 20])
def test_few_frames(frames: int) -> None:
    scene = make_scene(max(frames, 1))
    W, X = scene.W[:frames], scene.shapes[:frames]
    pairs = nearest(W, 16)
    assert pairs.frames.shape == (frames, min(16, max(frames - 1, 0)))
    reference = join(rigid_shapes(W, pairs), pairs)
    assert mirrored_frames(X, np.ones(X.shape[:2], bool), reference).share <= 0.5


def test_frames_without_an_extent_have_no_vote(scene: Scene) -> None:
    W = np.concatenate([scene.W[:400], np.zeros((5, P, 2))])
    pairs = nearest(whitened(W), 16)
    reference = join(rigid_shapes(W, pairs), pairs)
    assert np.isfinite(reference.shapes).all() and np.isfinite(reference.weights).all()
    test = mirrored_frames(np.zeros((405, P, 3)), np.ones((405, P), bool), reference)
    assert not test.mirrored.any()


def test_progress_is_reported() -> None:
    calls: list[tuple[int, int]] = []
    nearest(make_scene(600).W, 4, lambda done, total: calls.append((done, total)))
    assert calls[-1] == (600, 600) and len(calls) == 3
