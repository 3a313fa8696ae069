# SPDX-License-Identifier: Apache-2.0
"""Recombined shapes: which limbs are exchanged, and what they keep."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import CMU31
from deep_nrsfm_ros.nrsfm.factorisation.consensus import Consensus
from deep_nrsfm_ros.nrsfm.geometry import (
    align,
    centre,
    rotation_from_camera,
    rotation_from_vector,
)
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import AUTOMATIC, Recipe
from deep_nrsfm_ros.training import limb_exchange
from deep_nrsfm_ros.training.few_frames import FactorisedShapes
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.limb_exchange import LimbExchange, with_limb_exchange
from deep_nrsfm_ros.training.loop import train
from deep_nrsfm_ros.training.mirror import KnownShapesSource, MirrorCheck
from deep_nrsfm_ros.training.setup import Setup
from deep_nrsfm_ros.training.trainer import Trainer

BODY = ("a", "b", "c", "d", "shoulder", "elbow", "hand")
CHAIN = KeypointLayout("chain", BODY, edges=tuple(pairwise(BODY)))


def edge_lengths(S: np.ndarray, layout: KeypointLayout) -> np.ndarray:
    i, j = np.array(layout.edge_indices()).T
    lengths: np.ndarray = np.linalg.norm(S[:, i] - S[:, j], axis=2)
    return lengths


def people_of_one_size(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return shapes of `CMU31` with the same edge lengths in random directions."""
    lengths = rng.uniform(1, 2, len(CMU31.edges))
    directions = rng.standard_normal((n, len(CMU31.edges), 3))
    directions *= (lengths / np.linalg.norm(directions, axis=2))[..., None]
    S = np.zeros((n, len(CMU31), 3))
    for e, (i, j) in enumerate(CMU31.edge_indices()):  # an edge of the file ends nearer to the root
        S[:, i] = S[:, j] + directions[:, e]
    return centre(S)


def is_like(S: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return which shapes are a target, properly rotated."""
    apart = align(S, np.broadcast_to(target, S.shape)).aligned - target
    result: np.ndarray = np.linalg.norm(apart, axis=(1, 2)) < 1e-6
    return result


def test_a_limb_is_the_smaller_side_of_an_edge() -> None:
    exchange = LimbExchange(CMU31)
    edge = CMU31.edges.index(("lfemur", "lhipjoint"))
    limb = {CMU31.keypoints[i] for i in np.flatnonzero(exchange.limbs[edge])}
    assert limb == {"lfemur", "ltibia", "lfoot", "ltoes"}
    assert CMU31.keypoints[exchange.joints[edge]] == "lhipjoint"
    assert (2 * exchange.limbs.sum(1) <= len(CMU31)).all()


def test_shapes_exchange_a_limb(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limb_exchange, "_LIMBS", 1)
    monkeypatch.setattr(limb_exchange, "_ANGLE", 0.0)
    monkeypatch.setattr(limb_exchange, "_LENGTHS", 0.0)
    rng = np.random.default_rng(0)
    A = centre(rng.standard_normal((7, 3)))
    B = A.copy()
    R = rotation_from_vector(np.array([0.5, -0.3, 0.8]))
    B[5:] = A[4] + (A[5:] - A[4]) @ R  # elbow and hand, turned about the shoulder
    B = centre(B)
    elsewhere = 0.7 * B @ rotation_from_vector(np.array([0.2, 0.1, -0.4]))
    S = np.concatenate((np.tile(A, (600, 1, 1)), np.tile(elsewhere, (600, 1, 1))))
    recombined = LimbExchange(CHAIN).recombine(S, 600, rng)
    # Half of the partners are A itself; a third of the edges join the arm.
    assert is_like(recombined, A).mean() == pytest.approx(1 / 2, abs=0.07)
    assert is_like(recombined, B).mean() == pytest.approx(1 / 6, abs=0.05)


def test_edges_keep_their_lengths_up_to_the_drawn_ratio(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    S = people_of_one_size(300, rng)
    before = edge_lengths(S, CMU31)
    with monkeypatch.context() as patch:
        patch.setattr(limb_exchange, "_LENGTHS", 0.0)
        kept = LimbExchange(CMU31).recombine(S, 200, rng)
    assert np.abs(kept - S[:200]).max() > 1
    np.testing.assert_allclose(edge_lengths(kept, CMU31), before[:200], rtol=1e-6)
    changed = LimbExchange(CMU31).recombine(S, 200, rng)
    np.testing.assert_allclose(changed.mean(1), 0, atol=1e-9)
    ratio = np.log(edge_lengths(changed, CMU31) / before[:200])
    assert ratio.std() == pytest.approx(0.1, rel=0.05)
    assert ratio.mean() == pytest.approx(0, abs=0.01)


@pytest.mark.parametrize("edges", [(*CHAIN.edges, ("a", "hand")), ()])
def test_a_layout_that_no_edge_divides_is_refused(edges: tuple[tuple[str, str], ...]) -> None:
    with pytest.raises(ValueError, match=f"'ring' has no limbs: none of its {len(edges)} edges"):
        LimbExchange(KeypointLayout("ring", BODY, edges=edges))


def test_edges_of_a_ring_have_no_limbs_and_other_edges_have() -> None:
    ring = (("a", "b"), ("b", "c"), ("c", "d"), ("d", "a"))
    arm = (("d", "shoulder"), ("elbow", "shoulder"))  # the hand is joined to nothing
    exchange = LimbExchange(KeypointLayout("body", BODY, edges=(*ring, *arm)))
    limbs = [{BODY[i] for i in np.flatnonzero(limb)} for limb in exchange.limbs]
    assert limbs == [{"shoulder", "elbow"}, {"elbow"}]
    assert [BODY[joint] for joint in exchange.joints] == ["d", "shoulder"]
    S = np.random.default_rng(0).standard_normal((20, 7, 3))
    apart = exchange.recombine(S, 20, np.random.default_rng(1)) - centre(S)
    moved = apart - apart[:, :1]
    np.testing.assert_allclose(moved[:, [1, 2, 3, 6]], 0, atol=1e-9)
    assert np.abs(moved[:, 5]).max() > 0.1


@pytest.fixture(scope="module")
def limbs(figure: Any) -> LimbExchange:
    """The limbs of the figure, whose keypoints form a chain here."""
    names = figure.layout.keypoints
    return LimbExchange(KeypointLayout("chain", names, edges=tuple(pairwise(names))))


def weights_after(
    figure: Any, trained: Trainer, share: float, exchange: LimbExchange | None
) -> np.ndarray:
    recipe = dataclasses.replace(trained.preset.recipe, limb_exchange=share, steps=8)
    frames = FrameStore.of(figure.points, np.ones(figure.points.shape[:2], bool))
    setup = Setup(limb_exchange=exchange)
    trainer = Trainer(frames, trained.preset._replace(recipe=recipe), 0, setup)
    for _ in range(4):
        trainer.advance()
    result: np.ndarray = trainer.weights.numpy()
    return result


def test_a_share_of_the_known_shapes_is_recombined(
    figure: Any, trained: Trainer, limbs: LimbExchange
) -> None:
    plain = weights_after(figure, trained, 0.0, None)
    np.testing.assert_array_equal(weights_after(figure, trained, 0.0, limbs), plain)
    half = weights_after(figure, trained, 0.5, limbs)
    assert np.abs(half - plain).max() > 1e-4
    np.testing.assert_array_equal(weights_after(figure, trained, 0.5, limbs), half)


def test_only_the_first_shapes_are_recombined_and_fewer_with_progress(
    figure: Any, trained: Trainer, limbs: LimbExchange
) -> None:
    recipe = dataclasses.replace(trained.preset.recipe, limb_exchange=0.5, steps=8)
    frames = FrameStore.of(figure.points, np.ones(figure.points.shape[:2], bool))
    setup = Setup(limb_exchange=limbs)
    trainer = Trainer(frames, trained.preset._replace(recipe=recipe), 0, setup)
    trainer.advance()
    assert trainer.known is not None
    for step, recombined in ((0, 32), (4, 16), (8, 0)):
        trainer.step = step
        result = trainer.recombined()
        assert result is not None
        changed = (result.shapes != trainer.known.shapes).any(-1).any(-1).numpy()
        np.testing.assert_array_equal(changed, np.arange(64) < recombined)


def test_a_frame_keeps_its_shape_where_its_own_camera_sees_it(
    figure: Any, trained: Trainer, limbs: LimbExchange
) -> None:
    f = 40
    rotations = rotation_from_camera(figure.cameras[:f])
    found = Consensus(centre(figure.shapes[:f]), rotations, np.ones(f), 0.01, 5)
    recipe = dataclasses.replace(trained.preset.recipe, limb_exchange=1.0, steps=8)
    frames = FrameStore.of(figure.points[:f], np.ones(figure.points[:f].shape[:2], bool))
    setup = Setup(limb_exchange=limbs)
    trainer = Trainer(frames, trained.preset._replace(recipe=recipe), 0, setup)
    check, factorised = MirrorCheck(frames, Normaliser()), FactorisedShapes(found)
    KnownShapesSource(check, recipe, factorised).prepare(trainer)
    result = trainer.recombined()
    assert result is not None and trainer.known is not None
    shapes, cameras = result
    assert cameras is not None
    images = (cameras @ shapes[: len(cameras)].mT).mT.numpy()
    apart = images[:, None] - centre(figure.points[:f])
    assert np.linalg.norm(apart, axis=(2, 3)).min(1) == pytest.approx(0, abs=1e-4)
    changed = (shapes != trainer.known.shapes).any(-1).any(-1).numpy()
    np.testing.assert_array_equal(changed, np.arange(64) >= len(cameras))


def test_a_training_that_exchanges_limbs_needs_some(figure: Any, trained: Trainer) -> None:
    recipe = dataclasses.replace(trained.preset.recipe, limb_exchange=1, steps=1)
    visible = np.ones(figure.points.shape[:2], bool)
    with pytest.raises(ValueError, match="limb_exchange is 1, but there are no limbs to exchange"):
        train(figure.points, visible, trained.preset._replace(recipe=recipe))
    assert LimbExchange.of(figure.layout) is None


START = initialise(Architecture(widths=(4,)), 5, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("asked", "from_model", "has_limbs", "taken"),
    [
        (AUTOMATIC, True, True, 1),
        (AUTOMATIC, True, False, 0),
        (AUTOMATIC, False, True, 0),
        (0.5, False, True, 0.5),
        (0, True, True, 0),
    ],
)
def test_limbs_are_exchanged_by_themselves_only_where_a_model_is_the_start(
    asked: float, from_model: bool, has_limbs: bool, taken: float
) -> None:
    limbs = LimbExchange(CMU31) if has_limbs else None
    recipe = with_limb_exchange(Recipe(limb_exchange=asked), START if from_model else None, limbs)
    assert recipe.limb_exchange == taken


def test_limbs_that_a_layout_lacks_cannot_be_exchanged() -> None:
    with pytest.raises(ValueError, match="limb_exchange is 1, but there are no limbs to exchange"):
        with_limb_exchange(Recipe(limb_exchange=1), START, None)


@pytest.mark.parametrize(
    ("share", "allowed"), [(-0.5, "-1 or from 0 to 1"), (-2, "at least -1"), (1.5, "at least -1")]
)
def test_a_share_that_is_no_share_is_refused(share: float, allowed: str) -> None:
    with pytest.raises(ValueError, match=f"limb_exchange is {share}; it must be {allowed}"):
        with_limb_exchange(Recipe(limb_exchange=share), START, LimbExchange(CMU31))
