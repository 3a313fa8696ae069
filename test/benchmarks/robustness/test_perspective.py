# SPDX-License-Identifier: Apache-2.0
"""The camera sees what was put before it, and a perfect lifter would score perfectly."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.robustness import perspective
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.nrsfm.geometry import centre


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> perspective.Scene:
    monkeypatch.setattr(perspective, "NOISE", 0.0)
    rng = np.random.default_rng(0)
    shapes = centre(rng.uniform(-0.5, 0.5, (90, 17, 3))).astype(np.float32)
    flat = shapes[..., :2].copy()
    people = Dataset(flat, np.ones((90, 17), bool), HUMAN17, "made up", shapes)
    return perspective.random_scene(people, 0)


def test_people_stand_where_they_are_said_to_stand(scene: perspective.Scene) -> None:
    places = scene.shapes.mean(1)
    np.testing.assert_allclose(places[:, 2], perspective.DISTANCE, atol=1e-6)
    across = np.abs(places[:, :2]).max(0) / perspective.DISTANCE
    assert (across < perspective.SPREAD).all() and (across > 0.8 * perspective.SPREAD).all()
    seen = perspective.CAMERA.rays(scene.pixels)
    np.testing.assert_allclose(seen, scene.shapes[..., :2] / scene.shapes[..., 2:], atol=1e-5)
    neck, hip = HUMAN17.index("neck"), HUMAN17.index("mid_hip")
    length = np.linalg.norm(scene.shapes[:, neck] - scene.shapes[:, hip], axis=1).mean()
    assert scene.reference_length == pytest.approx(length)


def test_the_truth_has_no_error(scene: perspective.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    truth = {points.tobytes(): S for points, S in zip(scene.pixels, scene.shapes, strict=True)}

    def lift(lifter: Any, intrinsics: Any, points: Any, confidence: Any) -> Any:
        return SimpleNamespace(shapes=np.stack([truth[p.tobytes()] for p in points]))

    monkeypatch.setattr(perspective, "lift_perspective", lift)
    monkeypatch.setattr(perspective, "Lifter", lambda *_: None)
    lifting_errors = perspective.lifting_errors(None, scene, perspective.CAMERA)  # type: ignore[arg-type]
    assert tuple(lifting_errors) == tuple(perspective.FIGURES)
    np.testing.assert_allclose(list(lifting_errors.values()), 0, atol=1e-4)
