# SPDX-License-Identifier: Apache-2.0
"""The last step of a training; what else it makes is tested with the loop and with fine-tuning."""

from __future__ import annotations

from typing import Any

import numpy as np

from deep_nrsfm_ros.commands.evaluate import evaluate
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.training.finish import finish
from deep_nrsfm_ros.training.trainer import Trainer


def test_errors_are_taken_to_be_larger_than_on_frames_that_were_trained_on(
    trained: Trainer, figure: Any
) -> None:
    points = trained.sample(2048).points.numpy()
    same = Dataset(points, np.ones(points.shape[:2], bool), figure.layout, "people")
    measured = finish(trained, "figure", figure.layout, "test", same).error_covariance
    taken = finish(trained, "figure", figure.layout, "test").error_covariance
    np.testing.assert_allclose(taken, 4 * measured, rtol=0.05, atol=1e-3 * np.abs(taken).max())


def test_a_motion_that_was_not_trained_on_is_lifted_better_for_it(
    trained: Trainer, figure: Any
) -> None:
    stretch = np.array([1.3, 1, 0.8], np.float32)
    shapes = figure.shapes[:500] * stretch
    points = np.ascontiguousarray(shapes @ figure.cameras[:500])
    unseen = Dataset(points, np.ones(points.shape[:2], bool), figure.layout, "unseen", shapes)
    model = finish(trained, "figure", figure.layout, "test")
    confident = finish(trained, "figure", figure.layout, "test")
    confident.error_covariance[:] /= 4
    options = LiftingOptions()
    assert evaluate(model, unseen, options).shape < evaluate(confident, unseen, options).shape
