# SPDX-License-Identifier: Apache-2.0
"""The marks by which a model knows the frames of its training again."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.model_files.model_file import Model, load_model, save_model
from deep_nrsfm_ros.training import learned_frames
from deep_nrsfm_ros.training.fine_tuning import inherit
from deep_nrsfm_ros.training.finish import finish
from deep_nrsfm_ros.training.learned_frames import (
    LEARNED_FRAMES,
    frame_marks,
    learned_by,
    marks_in_words,
)
from deep_nrsfm_ros.training.trainer import Trainer


@pytest.fixture
def data(figure: Any) -> Dataset:
    visible = np.random.default_rng(0).random(figure.points.shape[:2]) > 0.1
    return Dataset(figure.points, visible, figure.layout, "test")


def model_of(model: Model, data: Dataset) -> Model:
    marks = marks_in_words(frame_marks(data.points, data.visible))
    return dataclasses.replace(model, provenance={LEARNED_FRAMES: marks})


@pytest.fixture(scope="module")
def any_model(figure: Any, trained: Trainer) -> Model:
    return finish(trained, "any", figure.layout, "test")


def test_marks_are_those_of_the_frame_moved_scaled_mirrored_and_rounded(data: Dataset) -> None:
    marks = frame_marks(data.points, data.visible)
    assert len(np.unique(marks)) > 0.99 * len(marks)
    for points in (300 * data.points + 1000, data.points * [-1, 1]):
        assert (frame_marks(points.astype(np.float32), data.visible) == marks).mean() > 0.9
    hidden = np.where(data.visible[..., None], data.points, 7)
    assert (frame_marks(hidden, data.visible) == marks).all()
    assert (frame_marks(data.points + np.eye(2)[0] * data.points, data.visible) != marks).all()


def test_a_model_knows_the_frames_of_its_training_and_no_others(
    data: Dataset, any_model: Model, tmp_path: Any
) -> None:
    half = len(data) // 2
    model = model_of(any_model, data[:half])
    save_model(tmp_path / "saved.safetensors", model)
    model = load_model(tmp_path / "saved.safetensors")
    assert learned_by(model, data[:half]).all()
    assert not learned_by(model, data[half:]).any()
    assert not learned_by(dataclasses.replace(model, provenance={}), data).any()
    damaged = dataclasses.replace(model, provenance={LEARNED_FRAMES: "§"})
    assert not learned_by(damaged, data).any()
    order = np.random.default_rng(1).permutation(len(data.layout))
    names = tuple(data.layout.keypoints[i] for i in order)
    layout = KeypointLayout("shuffled", names)
    shuffled = Dataset(data.points[:, order], data.visible[:, order], layout, "test")
    assert learned_by(model, shuffled[:half]).all()
    other = KeypointLayout("other", tuple(f"other_{i}" for i in order))
    assert not learned_by(model, dataclasses.replace(shuffled, layout=other)).any()


def test_a_recording_that_is_known_in_part_is_known(data: Dataset, any_model: Model) -> None:
    model = model_of(any_model, data[np.arange(0, 300, 5)])
    two = dataclasses.replace(data[:600], sequence_starts=np.array([0, 300]))
    learned = learned_by(model, two)
    assert learned[:300].all() and not learned[300:].any()


def test_of_many_frames_the_least_marks_tell(
    data: Dataset, any_model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learned_frames, "_MOST_MARKS", 64)
    model = model_of(any_model, data[:600])
    assert len(model.provenance[LEARNED_FRAMES]) < 400
    assert learned_by(model, data[:600]).all()
    assert not learned_by(model, data[600:]).any()


def test_a_model_has_learned_what_its_start_had_learned(
    figure: Any, any_model: Model, data: Dataset
) -> None:
    all_seen = dataclasses.replace(data, visible=np.ones_like(data.visible))
    assert learned_by(any_model, all_seen).all()  # `finish` has marked the frames
    moved = dataclasses.replace(all_seen, points=all_seen.points + all_seen.points[::-1])
    start = model_of(any_model, moved)
    assert not learned_by(any_model, moved).any()
    model = inherit(finish_again(any_model), start)
    assert learned_by(model, moved).all() and learned_by(model, all_seen).all()
    assert LEARNED_FRAMES not in model.provenance["from"]


def finish_again(model: Model) -> Model:
    return dataclasses.replace(model, provenance=dict(model.provenance))
