# SPDX-License-Identifier: Apache-2.0
"""Mirrored frames of a training: counted without labels, unknown where frames cannot tell."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch

from deep_nrsfm_ros.nrsfm.geometry import align, centre, random_cameras
from deep_nrsfm_ros.nrsfm.neighbours import MirrorTest
from deep_nrsfm_ros.nrsfm.network import Architecture
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import Preset, Recipe
from deep_nrsfm_ros.training import loop
from deep_nrsfm_ros.training.finish import finish
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.mirror import KnownShapesSource, MirrorCheck, most_frames, warning
from deep_nrsfm_ros.training.setup import Setup
from deep_nrsfm_ros.training.trainer import KnownShapes, Trainer


def frames_of(figure: Any, visible: np.ndarray | None = None) -> FrameStore:
    if visible is None:
        visible = np.ones(figure.points.shape[:2], bool)
    return FrameStore.of(figure.points, visible)


def mirror_half(check: MirrorCheck, monkeypatch: pytest.MonkeyPatch) -> np.ndarray:
    """Mirror the depth of the frames with a large first coordinate; return which."""
    lift = check.lift
    X = check.points[:, 4, 0]
    mirrored = np.quantile(X, 0.7) < X
    flip = np.where(mirrored[:, None, None], np.diag([1.0, 1, -1]), np.eye(3))
    monkeypatch.setattr(check, "lift", lambda net: lift(net) @ flip)
    return mirrored


def test_a_good_network_mirrors_nothing(figure: Any, trained: Trainer) -> None:
    check = MirrorCheck(frames_of(figure), Normaliser())
    assert check.share(trained.net) < 0.005
    assert trained.mirrored_share < 0.005
    quality = finish(trained, "figure", figure.layout, "test").quality
    assert quality["mirrored_share"] == round(trained.mirrored_share, 5)


def test_mirrored_frames_are_counted(
    figure: Any, trained: Trainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    check = MirrorCheck(frames_of(figure), Normaliser())
    mirrored = mirror_half(check, monkeypatch)
    assert (check.test(trained.net).mirrored ^ mirrored).mean() < 0.01
    assert check.share(trained.net) == pytest.approx(0.3, abs=0.01)


def test_missing_keypoints_are_bridged(figure: Any, trained: Trainer) -> None:
    visible = np.random.default_rng(0).random(figure.points.shape[:2]) > 0.15
    check = MirrorCheck(frames_of(figure, visible), Normaliser())
    assert check.share(trained.net) < 0.02


def test_reference_shapes_have_one_handedness(
    figure: Any, trained: Trainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    check = MirrorCheck(frames_of(figure), Normaliser())
    plain = check.reference_shapes(trained.net).numpy()
    mirror_half(check, monkeypatch)
    repaired = check.reference_shapes(trained.net).numpy()
    assert len(plain) > 0.9 * len(figure.points)
    # In the axes of the network, in which S is compared with them, not in any others.
    np.testing.assert_allclose(plain.mean(0), repaired.mean(0), atol=0.05)
    assert len(repaired) == len(plain)
    assert align(repaired, plain, allow_reflection=True).mirrored.mean() < 0.01


def test_a_fixed_camera_says_nothing(figure: Any) -> None:
    rng = np.random.default_rng(0)
    shapes = centre(rng.standard_normal((1, 12, 3)) + 1e-3 * rng.standard_normal((400, 12, 3)))
    points = (shapes @ random_cameras(1, rng)).astype(np.float32)
    visible = np.ones(points.shape[:2], bool)
    preset = Preset(Architecture(widths=(8, 4)), Normaliser(), Recipe(steps=4, batch=8, seeds=2))
    trainer = loop.train(points, visible, preset)
    assert math.isnan(trainer.mirrored_share)
    assert "mirrored_share" not in finish(trainer, "x", figure.layout, "test").quality
    assert not warning(trainer.mirrored_share)


def test_a_warning_gives_the_share() -> None:
    assert "38.4 %" in warning(0.384)
    assert not warning(0.001) and not warning(0.0)


@pytest.mark.parametrize(("shares", "tried"), [([0.0], 1), ([0.4, 0.0], 2), ([0.4, 0.3, 0.4], 3)])
def test_a_seed_that_mirrors_nothing_has_no_rivals(
    figure: Any, monkeypatch: pytest.MonkeyPatch, shares: list[float], tried: int
) -> None:
    recipe = Recipe(steps=40, batch=16, seeds=3, screening=4, mirror_repair="off")
    preset = Preset(Architecture(widths=(8, 4)), Normaliser(), recipe)
    measured = iter([*shares, 0.0])  # the last one is that of the end
    calls: list[float] = []

    def share(self: MirrorCheck, net: Any) -> float:
        calls.append(next(measured))
        return calls[-1]

    monkeypatch.setattr(MirrorCheck, "share", share)
    visible = np.ones(figure.points.shape[:2], bool)
    trainer = loop.train(figure.points, visible, preset)
    assert len(calls) == tried + 1
    assert trainer.seed == int(np.argmin(shares))


def test_the_reference_takes_a_small_part_of_the_training() -> None:
    assert most_frames(Recipe(steps=30_000)) == 15_000
    assert most_frames(Recipe(steps=1)) == 1000
    assert 1000 < most_frames(Recipe(steps=1000)) < 8000


def test_the_check_reports_progress(figure: Any, trained: Trainer) -> None:
    check = MirrorCheck(frames_of(figure), Normaliser(), most=600)
    calls: list[tuple[int, int]] = []
    check.on_progress = lambda done, total: calls.append((done, total))
    assert isinstance(check.test(trained.net), MirrorTest)
    check.test(trained.net)
    assert calls[-1] == (600, 600) and len(calls) == 3


def mirroring_trainer(figure: Any, trained: Trainer) -> Trainer:
    """Return a trainer whose network was taught to mirror the shapes on one side of a plane."""
    start = trained.net.map(lambda w: w.detach().numpy().copy())
    trainer = Trainer(frames_of(figure), trained.preset, 1, Setup(start))
    check = MirrorCheck(frames_of(figure), Normaliser())
    X = check.reference_shapes(trained.net)
    place = X[:, 5, 0]
    X[place > place.quantile(0.6)] *= torch.tensor([1.0, 1.0, -1.0])
    generator = torch.Generator().manual_seed(0)
    for _ in range(200):
        trainer.known = KnownShapes(X[torch.randint(len(X), (64,), generator=generator)])
        trainer.advance()
    return trainer


def test_a_network_that_mirrors_is_repaired(figure: Any, trained: Trainer) -> None:
    trainer = mirroring_trainer(figure, trained)
    check = MirrorCheck(frames_of(figure), Normaliser())
    assert check.share(trainer.net) > 0.1
    recipe = dataclasses.replace(trainer.preset.recipe, steps=2000)
    source = KnownShapesSource(check, recipe)
    for _ in range(400):
        source.prepare(trainer)
        trainer.advance()
    assert check.share(trainer.net) < 0.02


@pytest.mark.parametrize("repair", ["if_found", "always", "off"])
def test_who_is_taught(figure: Any, trained: Trainer, repair: str) -> None:
    recipe = dataclasses.replace(trained.preset.recipe, mirror_repair=repair, steps=10)
    start = trained.net.map(lambda w: w.detach().numpy().copy())
    check = MirrorCheck(frames_of(figure), Normaliser())
    trainer = Trainer(frames_of(figure), trained.preset._replace(recipe=recipe), 0, Setup(start))
    source = KnownShapesSource(check, recipe)
    taught = []
    for _ in range(4):
        source.prepare(trainer)
        taught.append(source.reference is not None)
        trainer.step += 1
    # The network mirrors nothing, so that nothing is repaired.
    assert taught == ([False, False, True, True] if repair == "always" else [False] * 4)


def test_without_a_cycle_loss_nothing_is_taught(figure: Any, trained: Trainer) -> None:
    recipe = dataclasses.replace(trained.preset.recipe, cycle=0.0)
    preset = trained.preset._replace(recipe=recipe)
    trainer = Trainer(frames_of(figure), preset, 0)
    source = KnownShapesSource(MirrorCheck(frames_of(figure), Normaliser()), recipe)
    source.prepare(trainer)
    assert source.reference is None and trainer.known is None
