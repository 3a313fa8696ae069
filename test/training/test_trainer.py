# SPDX-License-Identifier: Apache-2.0
"""One step of training: what the whitening is taken from, and how far each step goes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, Recipe
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.learning_rate import learning_rate
from deep_nrsfm_ros.training.trainer import second_moment


@pytest.mark.parametrize("scale", ["rms", "none"])
def test_second_moment_is_over_the_frames_that_show_both_points(figure: Any, scale: str) -> None:
    points = figure.points[:200] + np.array([3, 4], np.float32)
    visible = np.random.default_rng(0).random((200, 12)) < 0.7
    visible[:, :2], visible[:, 2], visible[:100, 3] = True, np.arange(200) >= 100, True
    visible[100:, 3] = False  # points 2 and 3 are never seen together
    total, seen = np.zeros((12, 12)), np.zeros((12, 12))
    for frame, there in zip(points.astype(float), visible, strict=True):
        W = frame - frame[there].mean(0)
        if scale == "rms":
            W /= 2 * (W[there] ** 2).sum(1).mean() ** 0.5
        for i in np.flatnonzero(there):
            for j in np.flatnonzero(there):
                total[i, j] += W[i] @ W[j]
                seen[i, j] += 1
    found = second_moment(FrameStore.of(points, visible), Normaliser(scale))
    assert seen[2, 3] == 0 == found[2, 3]
    np.testing.assert_allclose(found, total / np.maximum(seen, 1), atol=1e-5)


def test_learning_rates() -> None:
    cosine = Recipe(steps=1000, learning_rate=0.01)
    rates = [learning_rate(cosine, step) for step in (0, 500, 1000)]
    assert rates == pytest.approx([0.01, 0.005, 0.0])
    paper = PRESETS["paper"].recipe
    rates = [learning_rate(paper, step) for step in (0, 5000, 10000, 200_000)]
    assert rates == pytest.approx([1e-3, 1e-3 * 0.95**0.5, 1e-3 * 0.95, 1e-3 * 0.95**20])


@pytest.mark.parametrize("schedule", ["cosine", "exponential"])
def test_learning_rates_are_as_far_as_the_time(schedule: str) -> None:
    recipe = Recipe(steps=1000, schedule=schedule)
    for step, gone, as_at in ((100, 0.5, 500), (500, 0.1, 500), (0, 1.0, 1000), (7, 1.2, 1000)):
        assert learning_rate(recipe, step, gone) == pytest.approx(learning_rate(recipe, as_at))
