# SPDX-License-Identifier: Apache-2.0
"""Few frames: the network learns what factorisations agree on, and lifts new frames like any."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from deep_nrsfm_ros.nrsfm.factorisation.consensus import Consensus
from deep_nrsfm_ros.nrsfm.geometry import rotation_from_camera
from deep_nrsfm_ros.nrsfm.metrics import shape_errors
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, Preset, Recipe
from deep_nrsfm_ros.training import few_frames, loop
from deep_nrsfm_ros.training.few_frames import MAX_SPREAD, MIN_FRAMES, FactorisedShapes, factorise
from deep_nrsfm_ros.training.finish import finish
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.limits import Limits
from deep_nrsfm_ros.training.loop import Checkpointing
from deep_nrsfm_ros.training.setup import Setup

FRAMES = 40


def preset(**recipe: Any) -> Preset:
    return PRESETS["default"]._replace(recipe=Recipe(**{"steps": 2000, **recipe}))


def store(figure: Any, frames: int = FRAMES, hidden: float = 0.0) -> FrameStore:
    visible = np.random.default_rng(0).random(figure.points[:frames].shape[:2]) >= hidden
    return FrameStore.of(figure.points[:frames], visible)


def agreed(points: np.ndarray, spread: float = 0.01) -> Consensus:
    """Return a result of made-up depth."""
    shapes = np.concatenate((points, points[..., :1]), 2)
    rotations = np.tile(np.eye(3), (len(points), 1, 1))
    return Consensus(shapes, rotations, np.ones(len(points)), spread, 5)


def test_the_factorisation_of_few_frames_is_right(figure: Any) -> None:
    said: list[str] = []
    known = factorise(store(figure), preset(), on_message=said.append).shapes
    assert known is not None
    assert "time limit" not in said[0]
    assert shape_errors(known.shapes, figure.shapes[:FRAMES]).proper < 0.1


@pytest.mark.parametrize(
    ("recipe", "frames", "hidden"),
    [
        ({"few_frames": 0}, FRAMES, 0.0),
        ({"few_frames": FRAMES - 1}, FRAMES, 0.0),
        ({"steps": 100}, FRAMES, 0.0),
        ({"cycle": 0.0}, FRAMES, 0.0),
        ({}, MIN_FRAMES - 1, 0.0),
        ({}, FRAMES, 0.4),
    ],
)
def test_where_it_has_no_place_nothing_is_factorised(
    figure: Any,
    recipe: dict[str, Any],
    frames: int,
    hidden: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(few_frames, "consensus", lambda W, *_: agreed(W))
    said: list[str] = []
    assert factorise(store(figure), preset(), on_message=said.append).shapes is not None
    none = factorise(store(figure, frames, hidden), preset(**recipe), on_message=said.append)
    assert none == (None, 0)
    assert [f"{FRAMES} frames" in sentence for sentence in said[:1]] == [True]  # of the first alone
    assert ["fewer than 2000 steps" in sentence for sentence in said[1:]] == (
        [True] if "steps" in recipe else []
    )


def test_solutions_that_disagree_are_not_believed(
    figure: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(few_frames, "consensus", lambda W, *_: agreed(W, 1.01 * MAX_SPREAD))
    assert factorise(store(figure), preset()).shapes is None


def test_missing_keypoints_are_filled_in(figure: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr(few_frames, "consensus", lambda W, *_: seen.append(W) or agreed(W))
    factorise(store(figure, hidden=0.1), preset())
    points = figure.points[:FRAMES] - figure.points[:FRAMES].mean(1, keepdims=True)
    filled = seen[0] - seen[0].mean(1, keepdims=True)
    assert np.linalg.norm(filled - points) < 0.2 * np.linalg.norm(points)


def test_taught_shapes_are_known_or_lie_between_known_ones() -> None:
    known = np.stack((np.zeros((5, 3)), np.ones((5, 3))))
    rotations = np.stack((np.eye(3), np.diag([-1.0, -1.0, 1.0])))
    factorised = FactorisedShapes(Consensus(known, rotations, np.ones(2), 0.01, 5))
    taught, cameras = factorised.draw(64, torch.Generator().manual_seed(0))
    assert cameras is not None
    own = torch.where(taught[:16, 0, 0] > 0, -1.0, 1.0)  # the camera of the same frame
    torch.testing.assert_close(cameras[:, 0, 0], own)
    assert taught.shape == (64, 5, 3)
    assert set(taught[:32].unique().tolist()) == {0.0, 1.0}
    between = taught[32:]
    assert ((between >= 0) & (between <= 1)).all()
    assert len(between.unique()) > 5


def test_the_network_is_taught_the_factorisation(
    figure: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(few_frames, "MIN_STEPS", 1)
    points, truth = figure.points[:FRAMES], figure.shapes[:FRAMES]
    mirror = np.array([1, 1, -1])
    rotations = rotation_from_camera(figure.cameras[:FRAMES] * mirror[:, None])
    turned = Consensus(truth * mirror, rotations, np.ones(FRAMES), 0.01, 5)
    monkeypatch.setattr(few_frames, "consensus", lambda *_: turned)
    small = preset(steps=300)
    small = small._replace(architecture=dataclasses.replace(small.architecture, widths=(64, 32)))
    trainer = loop.train(points, np.ones(points.shape[:2], bool), small)
    assert trainer.factorisation is turned
    assert shape_errors(trainer.factorisation.shapes, truth).proper < 1e-6
    model = finish(trainer, "few", figure.layout, "test")
    assert model.provenance["factorisation"] == {"solutions": 5, "spread": 0.01}
    assert trainer.measure()[1] < 0.2


def test_it_can_be_stopped_within_a_factorisation(figure: Any) -> None:
    answers = iter([False] * 40 + [True])
    assert factorise(store(figure), preset(), lambda: next(answers)).shapes is None
    assert next(answers, "none is left") == "none is left"


def cut_short(monkeypatch: pytest.MonkeyPatch, results: int, needed: float) -> None:
    """Let the factorisations find so many results, and go on for longer than they may."""

    def endless(
        W: np.ndarray, before_each: Callable[[], None], on_result: Callable[[Consensus], None]
    ) -> None:
        for i in range(results):
            on_result(agreed(W)._replace(solutions=i))
        while True:
            before_each()
            time.sleep(0.01)

    monkeypatch.setattr(few_frames, "consensus", endless)
    monkeypatch.setattr(few_frames, "seconds_at_most", lambda *_: needed)


def test_the_best_shapes_until_then_are_kept_where_the_time_is_up(
    figure: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    cut_short(monkeypatch, results=2, needed=75)
    found = factorise(store(figure), preset(), on_message=said.append, most_seconds=0.05)
    assert found.shapes is not None
    assert found.shapes.solutions == 1
    assert found.minutes_needed == 2  # of which they have two thirds
    assert f"of all {FRAMES} frames come first and take up to about 75 s here" in said[0]
    assert (
        "; the time limit leaves them 0 s, --minutes 2 (train.minutes) would be enough" in said[0]
    )
    assert "the network learns the less exact shapes that they found until then" in said[-1]
    assert "they need up to about 75 s here: give --minutes 2 (train.minutes)" in said[-1]


def test_where_there_is_no_time_for_any_the_message_says_what_would_help(
    figure: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    cut_short(monkeypatch, results=0, needed=130)
    found = factorise(store(figure), preset(), on_message=said.append, most_seconds=0.05)
    assert found == (None, 3.5)
    assert "the network learns without them, and may come out mirrored in part" in said[-1]
    assert "give --minutes 3.5 (train.minutes), or leave it out" in said[-1]


def test_shapes_without_agreement_are_not_taught_where_the_time_is_up(
    figure: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut_short(monkeypatch, results=1, needed=75)
    monkeypatch.setattr(few_frames, "MAX_SPREAD", 0.001)
    said: list[str] = []
    found = factorise(store(figure), preset(), on_message=said.append, most_seconds=0.05)
    assert found.shapes is None
    assert "the network learns without them" in said[-1]


def test_a_third_of_a_time_limit_is_left_for_the_steps(
    figure: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut_short(monkeypatch, results=0, needed=75)
    points, limits = figure.points[:FRAMES], Limits(minutes=0.03)
    began = time.monotonic()
    trainer = loop.train(points, np.ones(points.shape[:2], bool), preset(), Setup(limits=limits))
    assert trainer.factorisation is None
    assert trainer.step > 0
    assert time.monotonic() - began < 4
    assert finish(trainer, "few", figure.layout, "test").provenance[
        "factorisation_needs_minutes"
    ] == pytest.approx(2)


def test_a_training_continues_with_the_shapes_of_its_checkpoint(
    figure: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    points, file = figure.points[:FRAMES], tmp_path / "checkpoint.safetensors"
    calls: list[float] = []

    def found(*args: Any) -> few_frames.Factorised:
        calls.append(args[-1])
        return few_frames.Factorised(agreed(points), 2.5)

    monkeypatch.setattr(loop, "factorise", found)
    trainers = []
    for before_stop in (5, 0, 5):
        stops = iter([False] * before_stop + [True] * 99)
        trainers.append(
            loop.train(
                points,
                np.ones(points.shape[:2], bool),
                preset(seed=1),
                callbacks=loop.Callbacks(should_stop=stops.__next__),
                checkpointing=Checkpointing(file),
            )
        )
    assert [trainer.step for trainer in trainers] == [5, 5, 10]
    assert len(calls) == 1
    for trainer in trainers:
        assert trainer.minutes_needed == 2.5
        assert trainer.factorisation is not None
        np.testing.assert_array_equal(trainer.factorisation.shapes, agreed(points).shapes)
        assert trainer.factorisation.solutions == 5


def test_factorised_shapes_are_saved_with_the_first_step(
    figure: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    points, file = figure.points[:FRAMES], tmp_path / "checkpoint.safetensors"
    found = few_frames.Factorised(agreed(points))
    monkeypatch.setattr(loop, "factorise", lambda *_: found)
    there: list[bool] = []
    stops = iter([False] * 3 + [True])
    callbacks = loop.Callbacks(
        on_step=lambda trainer: there.append(file.exists()), should_stop=stops.__next__
    )
    visible = np.ones(points.shape[:2], bool)
    loop.train(points, visible, preset(), callbacks=callbacks, checkpointing=Checkpointing(file))
    assert there == [False, False, True, True]


def test_a_training_continues_without_factorisations_if_it_had_none(
    figure: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    points, file = figure.points[:FRAMES], tmp_path / "checkpoint.safetensors"
    visible = np.ones(points.shape[:2], bool)
    monkeypatch.setattr(loop, "factorise", lambda *_: few_frames.Factorised())
    stops = iter([False] * 5 + [True] * 99)
    stopping = loop.Callbacks(should_stop=lambda: next(stops))
    loop.train(points, visible, preset(), callbacks=stopping, checkpointing=Checkpointing(file))
    monkeypatch.undo()
    stops = iter([False] * 5 + [True] * 99)
    stopping = loop.Callbacks(should_stop=lambda: next(stops))
    trainer = loop.train(
        points, visible, preset(), callbacks=stopping, checkpointing=Checkpointing(file)
    )
    assert trainer.factorisation is None
    assert trainer.step == 10
