# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from benchmarks.data.mat_files import read_category, read_sequence
from deep_nrsfm_ros.nrsfm.geometry import random_cameras

F, P = 5, 7


@pytest.fixture
def shapes() -> np.ndarray:
    return np.random.default_rng(0).standard_normal((F, P, 3)) + [10, 20, 30]


def rows(X: np.ndarray) -> np.ndarray:
    """(f, p, d) as a matrix with d rows a frame."""
    return X.swapaxes(1, 2).reshape(-1, X.shape[1])


def centred(X: np.ndarray) -> np.ndarray:
    return X - X.mean(1, keepdims=True)


def test_sequence_with_a_world_is_centred_images_and_truth(
    tmp_path: Path, shapes: np.ndarray
) -> None:
    cameras = random_cameras(F, np.random.default_rng(1))
    savemat(tmp_path / "walk.mat", {"W": rows(shapes @ cameras), "S": rows(shapes)})
    sequence = read_sequence(tmp_path / "walk.mat")
    assert not sequence.in_camera_axes
    assert sequence.dataset.shapes is not None
    np.testing.assert_allclose(sequence.dataset.shapes, centred(shapes), atol=1e-5)
    np.testing.assert_allclose(sequence.dataset.points, centred(shapes) @ cameras, atol=1e-5)
    assert sequence.dataset.visible.all()
    assert sequence.dataset.source == "walk"


def test_sequence_without_a_world_has_its_truth_in_camera_axes(
    tmp_path: Path, shapes: np.ndarray
) -> None:
    truth = {"shape3D": rows(shapes)}
    savemat(tmp_path / "face.mat", {"W": rows(shapes[..., :2]), "GT": truth})
    sequence = read_sequence(tmp_path / "face.mat")
    assert sequence.in_camera_axes
    assert sequence.dataset.shapes is not None
    np.testing.assert_allclose(sequence.dataset.shapes[..., :2], sequence.dataset.points)


def test_category_is_a_shape_an_object(tmp_path: Path, shapes: np.ndarray) -> None:
    savemat(tmp_path / "faces.mat", {"X": shapes.transpose(2, 1, 0)})
    np.testing.assert_array_equal(read_category(tmp_path / "faces.mat"), shapes)


@pytest.mark.parametrize(
    "content",
    [
        {"S": np.zeros((6, 4))},
        {"W": np.zeros((4, 4))},
        {"W": np.zeros((4, 4)), "S": np.zeros((5, 4))},
        {"W": np.zeros((3, 4)), "S": np.zeros((6, 4))},
        {"W": np.zeros((4, 4)), "GT": {"other": np.zeros((6, 4))}},
    ],
    ids=["no images", "no truth", "too little truth", "half a frame", "truth of another name"],
)
def test_sequences_that_do_not_fit_are_refused_by_name(
    tmp_path: Path, content: dict[str, Any]
) -> None:
    savemat(tmp_path / "bad.mat", content)
    with pytest.raises(ValueError, match=r"bad\.mat has no W"):
        read_sequence(tmp_path / "bad.mat")


@pytest.mark.parametrize("content", [{"Y": np.zeros((3, 4, 5))}, {"X": np.zeros((4, 3, 5))}])
def test_categories_that_do_not_fit_are_refused_by_name(
    tmp_path: Path, content: dict[str, Any]
) -> None:
    savemat(tmp_path / "bad.mat", content)
    with pytest.raises(ValueError, match=r"bad\.mat has no X"):
        read_category(tmp_path / "bad.mat")


@pytest.mark.parametrize(
    "content", [b"", b"not a mat file at all" * 20, b"MATLAB 5.0" + bytes(200)]
)
@pytest.mark.parametrize("read", [read_sequence, read_category])
def test_other_files_are_refused_by_name(
    tmp_path: Path, read: Callable[[Path], Any], content: bytes
) -> None:
    (tmp_path / "bad.mat").write_bytes(content)
    with pytest.raises(ValueError, match=r"bad\.mat"):
        read(tmp_path / "bad.mat")
