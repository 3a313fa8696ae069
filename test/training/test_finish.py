# SPDX-License-Identifier: Apache-2.0
"""The last step of a training; what else it makes is tested with the loop and with fine-tuning."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import numpy as np

from deep_nrsfm_ros.commands.evaluate import evaluate
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.virtual_people import FACE_KEYPOINTS
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.metrics import shape_errors
from deep_nrsfm_ros.training.finish import finish
from deep_nrsfm_ros.training.trainer import Trainer


def model_with(trained: Trainer, figure: Any, scale: float) -> Model:
    """Return the model of a trainer whose recipe has an error scale."""
    recipe = dataclasses.replace(trained.preset.recipe, error_scale=scale)
    other = copy.copy(trained)
    other.preset = trained.preset._replace(recipe=recipe)
    return finish(other, "figure", figure.layout, "test")


def test_errors_may_be_taken_to_be_larger_than_on_frames_that_were_trained_on(
    trained: Trainer, figure: Any
) -> None:
    points = trained.sample(2048).points.numpy()
    same = Dataset(points, np.ones(points.shape[:2], bool), figure.layout, "people")
    measured = finish(trained, "figure", figure.layout, "test", same).error_covariance
    for scale in (1, 4):
        taken = model_with(trained, figure, scale).error_covariance
        tolerance = 1e-3 * np.abs(taken).max()
        np.testing.assert_allclose(taken, scale * measured, rtol=0.05, atol=tolerance)


def test_a_motion_that_was_not_trained_on_is_lifted_better_for_it(
    trained: Trainer, figure: Any
) -> None:
    stretch = np.array([1.3, 1, 0.8], np.float32)
    shapes = figure.shapes[:500] * stretch
    points = np.ascontiguousarray(shapes @ figure.cameras[:500])
    unseen = Dataset(points, np.ones(points.shape[:2], bool), figure.layout, "unseen", shapes)
    model, confident = (model_with(trained, figure, scale) for scale in (4, 1))
    options = LiftingOptions()
    assert evaluate(model, unseen, options).shape < evaluate(confident, unseen, options).shape


def test_the_error_covariance_without_a_face_is_that_of_lifts_without_it(
    trained: Trainer, figure: Any
) -> None:
    names = figure.layout.keypoints[: -len(FACE_KEYPOINTS)]
    layout = dataclasses.replace(figure.layout, keypoints=(*names, *FACE_KEYPOINTS))
    model = finish(trained, "figure", layout, "test")
    assert model.hidden_keypoints == FACE_KEYPOINTS
    usual = dataclasses.replace(model, hidden_keypoints=())
    blind = KeypointLayout("blind", names)
    errors = [
        shape_errors(Lifter(m, layout=blind)(figure.points[:, : len(names)]).shapes, figure.shapes)
        for m in (usual, model)
    ]
    assert errors[1].shape < errors[0].shape
