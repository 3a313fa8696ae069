# SPDX-License-Identifier: Apache-2.0
"""The zoo's scenes are divided by time, and its figures are those of the shapes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.real import zoo
from deep_nrsfm_ros.nrsfm.geometry import random_cameras


@pytest.fixture
def fly(tmp_path: Path) -> Path:
    """Write a scene of two cameras and ten frames; the second camera is behind the first."""
    rng = np.random.default_rng(0)
    truth = rng.normal(0, 1, (10, 1, 12, 3))
    R = np.stack((np.eye(3), np.diag([-1.0, 1, -1])))
    points = np.einsum("vij,fnpj->fvnpi", R, truth)[..., :2]
    points[3, 1, 0, 4] = np.nan
    (tmp_path / "fly_eks").mkdir()
    np.savez(tmp_path / "fly_eks" / "fly_eks.npz", points=points, truth=truth, R=R)
    return tmp_path


def test_a_scene_is_divided_by_time_and_each_view_is_a_frame(fly: Path) -> None:
    thing = zoo.fly(fly)
    assert len(thing.training) == 16 and len(thing.test) == 4
    assert (~thing.training.visible).sum() == 1
    assert thing.test.shapes is not None
    S = thing.test.shapes - thing.test.shapes.mean(1, keepdims=True)
    W = thing.test.points - thing.test.points.mean(1, keepdims=True)
    np.testing.assert_allclose(S[..., :2], W, atol=1e-5)


def test_right_shapes_have_no_error_and_a_reflection_of_all_is_forgiven(fly: Path) -> None:
    thing = zoo.fly(fly)
    assert thing.test.shapes is not None
    residual = np.full(4, 0.1)
    for mirror in ([1, 1, 1], [1, 1, -1]):
        shown = zoo.figures(thing, thing.test.shapes * mirror, residual)
        assert shown["PA %"] == pytest.approx(0, abs=1e-3)
        assert shown["mirrored %"] == 0
        assert shown["image error %"] == pytest.approx(10)
        assert shown["rigid PA %"] > 30 and shown["true mean PA %"] > 30


def test_the_rigid_shape_is_found_from_images_of_different_scales_alone() -> None:
    rng = np.random.default_rng(0)
    S = rng.normal(0, 1, (12, 3))
    points = (S @ random_cameras(40, rng)) * rng.uniform(0.5, 2, (40, 1, 1))
    points[3, 5] = np.nan  # a frame that is left out
    training = zoo._dataset(points, zoo._layout("fly12"), "made")
    found = zoo.rigid_factorised(training)[None]
    errors = [zoo.relative_distance(found * mirror, S[None]) for mirror in ([1, 1, 1], [1, 1, -1])]
    assert min(errors) < 0.01


def test_photographs_have_no_truth_and_few_points_are_left_out(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(0, 99, (30, 15, 2))
    points[4, 3:] = np.nan
    (tmp_path / "birds_cub").mkdir()
    np.savez(tmp_path / "birds_cub" / "birds_cub.npz", points=points)
    thing = zoo.birds(tmp_path)
    assert len(thing.training) == 26 and len(thing.test) == 3
    assert set(zoo.figures(thing, np.zeros((3, 15, 3)), np.ones(3))) == {"image error %"}


@pytest.mark.parametrize("name", ["mouse22", "fly12", "chair10", "bird15", "car20"])
def test_layouts_can_be_read(name: str) -> None:
    layout = zoo._layout(name)
    assert layout.name == name and layout.edge_indices()
