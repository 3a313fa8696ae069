"""A synthetic non-rigid object that every test of the method can learn, and one training of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest
import torch

from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras
from deep_nrsfm_ros.nrsfm.keypoints import KeypointLayout
from deep_nrsfm_ros.nrsfm.network import Architecture
from deep_nrsfm_ros.nrsfm.normaliser import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import Preset, Recipe
from deep_nrsfm_ros.nrsfm.trainer import Trainer
from deep_nrsfm_ros.nrsfm.training import train


@pytest.fixture(params=[16, 32, 64])
def vectors(request: pytest.FixtureRequest) -> Iterator[None]:
    """Try vectors of all lengths in the compiled kernel, as far as the processor has them."""
    from deep_nrsfm_ros.nrsfm import _kernel

    if _kernel.choose_vectors(request.param) != request.param:
        pytest.skip(f"this processor has no vectors of {request.param} bytes")
    yield
    _kernel.choose_vectors(64)


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


class Figure(NamedTuple):
    """Shapes in object axes (x front, y left, z up) and what cameras see of them."""

    layout: KeypointLayout
    shapes: np.ndarray  # (f, 12, 3)
    cameras: np.ndarray  # (f, 3, 2)
    points: np.ndarray  # (f, 12, 2)


@pytest.fixture(scope="session")
def figure() -> Figure:
    """An object of 12 points that deforms: a mean shape and three non-negative modes."""
    rng = np.random.default_rng(0)
    names = ("left", "right", "up", "front", *(f"point_{i}" for i in range(4, 12)))
    layout = KeypointLayout("figure", names, handedness=(names[:4],), reference=("left", "right"))
    mean = rng.standard_normal((12, 3))
    mean[:4] = [[0, 1.5, 0], [0, -1.5, 0], [0, 0, 1.5], [1.5, 0, 0]]
    modes = 0.6 * rng.standard_normal((3, 12, 3))
    modes[:, :4] /= 4
    codes = rng.uniform(0, 1, (2000, 3))
    shapes = centre(mean + np.einsum("fk,kpd->fpd", codes, modes)).astype(np.float32)
    cameras = random_cameras(len(shapes), rng)
    return Figure(layout, shapes, cameras, shapes @ cameras)


@pytest.fixture(scope="session")
def trained(figure: Figure) -> Trainer:
    """A small network trained on the figure's points for some seconds."""
    recipe = Recipe(steps=800, batch=64, learning_rate=1e-2)
    preset = Preset(Architecture(widths=(64, 32, 16)), Normaliser(), recipe)
    return train(figure.points, np.ones(figure.points.shape[:2], bool), preset)
