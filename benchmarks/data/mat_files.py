# SPDX-License-Identifier: Apache-2.0
"""Readers of the MATLAB files of the classic sequences and of FRGC faces."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.nrsfm.geometry import centre


class Sequence(NamedTuple):
    """A sequence of images with ground truth, both centred.

    Attributes:
        dataset: images and truth.
        in_camera_axes: whether the truth is in the axes of each camera, not of a fixed world.
    """

    dataset: Dataset
    in_camera_axes: bool  # of the ground truth: x, y and depth of each frame, not of a fixed world


def read_sequence(path: Path) -> Sequence:
    """Read W (2f, p) with rows x, y, x, ... and its truth: S (3f, p), or GT.shape3D.

    S is in the axes of the world, GT.shape3D in those of the camera.

    Raises:
        ValueError: arrays are missing or do not fit; the message names the file.
    """
    found = _load(path)
    try:
        in_camera_axes = "S" not in found
        truth = found["GT"]["shape3D"][0, 0] if in_camera_axes else found["S"]
        p = found["W"].shape[1]
        W = found["W"].reshape(-1, 2, p).swapaxes(1, 2)
        S = truth.reshape(len(W), 3, p).swapaxes(1, 2)
    except (KeyError, IndexError, ValueError) as error:
        raise ValueError(
            f"{path} has no W (2f, p) with S or GT.shape3D (3f, p): {error}"
        ) from error
    return Sequence(observed(W, S, path.stem), in_camera_axes)


def read_category(path: Path) -> NDArray[np.float64]:
    """Return the shapes X (3, p, n) of a category as (n, p, 3).

    Raises:
        ValueError: the file has no such array; the message names the file.
    """
    X = _load(path).get("X")
    if X is None or X.ndim != 3 or X.shape[0] != 3:
        raise ValueError(f"{path} has no X (3, p, n)")
    return np.asarray(X, np.float64).transpose(2, 1, 0)


def observed(W: NDArray[Any], S: NDArray[Any], source: str) -> Dataset:
    """Return images W (f, p, 2) with truth S (f, p, 3) as a dataset of numbered keypoints."""
    layout = KeypointLayout.numbered(W.shape[1])
    points, shapes = (centre(X).astype(np.float32) for X in (W, S))
    return Dataset(points, np.ones(W.shape[:2], bool), layout, source, shapes)


def _load(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            return dict(loadmat(file))
    except (MatReadError, NotImplementedError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is not a readable MATLAB file: {error}") from error
