# SPDX-License-Identifier: Apache-2.0
"""The best state is kept, a standstill ends a training, and looking is cheap."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.nrsfm.network import Architecture
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, Preset, Recipe
from deep_nrsfm_ros.training import best_checkpoint as best
from deep_nrsfm_ros.training.finish import finish
from deep_nrsfm_ros.training.limits import WHOLE, Limits
from deep_nrsfm_ros.training.loop import train
from deep_nrsfm_ros.training.trainer import Trainer
from test.fixtures.training_options import by_dataclass

RECIPE = Recipe(steps=40, batch=16, seeds=1)
PRESET = Preset(Architecture(widths=(8, 4)), Normaliser(), RECIPE)
FRAMES = 200
"""Of the object's frames: which state is kept does not depend on how many there are."""


def run(figure: Any, **how: Any) -> Trainer:
    points = figure.points[:FRAMES]
    return train(points, np.ones(points.shape[:2], bool), PRESET, **by_dataclass(**how))


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Callable[[list[float]], dict[int, np.ndarray]]:
    """Look every 4 steps and find what the test says; return the weights at each step."""
    monkeypatch.setattr(best, "steps_between", lambda recipe: 4)

    def tell(qualities: list[float]) -> dict[int, np.ndarray]:
        weights: dict[int, np.ndarray] = {}

        def quality(trainer: Trainer) -> float:
            weights.setdefault(trainer.step, trainer.weights.numpy().copy())
            return qualities[min(trainer.step // 4 - 1, len(qualities) - 1)]

        monkeypatch.setattr(Trainer, "quality", quality)
        return weights

    return tell


def test_the_best_state_is_kept(figure: Any, told: Any) -> None:
    weights = told([5, 4, 3, 9, 6, 5, 4])
    trainer = run(figure, limits=Limits())
    np.testing.assert_array_equal(trainer.weights, weights[12])
    assert (trainer.step, trainer.kept_step, trainer.end_reason) == (40, 12, "all steps were taken")
    assert finish(trainer, "figure", figure.layout, "test").provenance["kept_step"] == 12


@pytest.mark.parametrize(
    ("qualities", "limits"), [([5, 4, 3, 2, 2], Limits()), ([5, 4, 3, 9], WHOLE)]
)
def test_the_last_state_is_kept(
    figure: Any, told: Any, qualities: list[float], limits: Limits
) -> None:
    told(qualities)
    trainer, last = run(figure, limits=limits), run(figure)
    assert trainer.kept_step is None
    np.testing.assert_array_equal(trainer.weights, last.weights)
    assert "kept_step" not in finish(trainer, "figure", figure.layout, "test").provenance


def test_it_ends_when_it_no_longer_improves(figure: Any, told: Any) -> None:
    told([5, 4, 3.99, 3.98, 3.97, 2, 1])
    trainer = run(figure, limits=Limits(patience=0.15))
    assert (trainer.step, trainer.end_reason) == (16, "its quality no longer improved")
    assert run(figure, limits=Limits(patience=0.5)).step == 40
    assert run(figure, limits=Limits(patience=0.15, keep_best=False)).kept_step is None


def test_what_is_cancelled_keeps_the_best_and_goes_on_from_the_last(
    figure: Any, told: Any, tmp_path: Path
) -> None:
    weights = told([5, 3, 9, 8, 7, 6, 5, 4, 4, 4])
    whole = run(figure, limits=Limits())
    calls = iter(range(10**6))
    how = {"limits": Limits(), "file": tmp_path / "checkpoint"}
    cancelled = run(figure, **how, should_stop=lambda: next(calls) >= 18)
    assert (cancelled.step, cancelled.kept_step, cancelled.end_reason) == (18, 8, "")
    np.testing.assert_array_equal(cancelled.weights, weights[8])
    steps: list[int] = []
    went_on = run(figure, **how, on_step=lambda trainer: steps.append(trainer.step))
    assert steps == list(range(18, 41)) and went_on.kept_step == whole.kept_step == 8
    np.testing.assert_array_equal(went_on.weights, whole.weights)


def test_the_patience_goes_on_too(figure: Any, told: Any, tmp_path: Path) -> None:
    told([5, 3, 4])
    calls = iter(range(10**6))
    how = {"limits": Limits(patience=0.35), "file": tmp_path / "checkpoint"}
    run(figure, **how, should_stop=lambda: next(calls) >= 18)
    assert run(figure, **how).step == 24


def test_looking_does_not_change_the_training(figure: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(best, "steps_between", lambda recipe: 3)
    last = run(figure, limits=Limits(keep_best=False, patience=1.0))
    np.testing.assert_array_equal(last.weights, run(figure).weights)


@pytest.mark.parametrize("recipe", [preset.recipe for preset in PRESETS.values()])
def test_looks_are_few(recipe: Recipe) -> None:
    assert recipe.steps / best.steps_between(recipe) <= 50
    short = dataclasses.replace(recipe, steps=100)
    assert best.steps_between(short) > 100
    assert best.steps_between(dataclasses.replace(short, batch=65536)) == 2
