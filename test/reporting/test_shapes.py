# SPDX-License-Identifier: Apache-2.0
"""The mean shape and the deformations of an object that a model has lifted."""

from __future__ import annotations

import numpy as np

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.geometry import align, centre, random_cameras, rotation_from_camera
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.reporting.shapes import shape_space

P = 10


def model(layout: KeypointLayout) -> Model:
    net = initialise(Architecture(widths=(8, 4)), len(layout), np.random.default_rng(0))
    return Model("mine", net, layout, Normaliser(), np.eye(3, dtype=np.float32))


def lifted(S: np.ndarray, seed: int = 0) -> Lifted:
    """Return object shapes S (f, p, 3) as a perfect lifter would."""
    R = rotation_from_camera(random_cameras(len(S), np.random.default_rng(seed)))
    ones = np.ones(len(S), np.float32)
    nothing = np.zeros((len(S), 1), np.bool_)
    places = np.zeros((len(S), 2), np.float32)
    return Lifted(S @ R.swapaxes(1, 2), R, ones, places, 0 * ones, ones[:, None], nothing)


def test_the_modes_are_those_of_the_object() -> None:
    rng = np.random.default_rng(2)
    mean, *modes = centre(rng.standard_normal((3, P, 3)))
    weights = rng.standard_normal((400, 2)) * [0.1, 0.04]
    S = mean + np.einsum("fk,kpd->fpd", weights, np.array(modes))
    space = shape_space(model(KeypointLayout.numbered(P)), lifted(S), modes=3)
    unit = mean / np.sqrt((mean**2).sum(1).mean())
    assert np.abs(align(space.mean, unit).aligned - unit).max() < 0.05
    assert space.modes.shape == (3, P, 3)
    assert (np.diff(space.shares) <= 0).all() and space.shares[0] > 0.6
    assert space.shares[:2].sum() > 0.95


def test_a_person_faces_the_viewer() -> None:
    rng = np.random.default_rng(3)
    mean = centre(rng.standard_normal((17, 3)))  # x front, y left, z up
    space = shape_space(model(HUMAN17), lifted(mean + 0.05 * rng.standard_normal((50, 17, 3))))
    screen = space.mean[:, [2, 0, 1]]
    assert (screen * mean).sum() / np.linalg.norm(screen) / np.linalg.norm(mean) > 0.99


def test_an_object_without_front_stands_upright_and_is_not_mirrored() -> None:
    rng = np.random.default_rng(4)
    mean = centre(rng.standard_normal((P, 3)) * [5, 1, 2])
    shown = shape_space(model(KeypointLayout.numbered(P)), lifted(np.repeat(mean[None], 9, 0))).mean
    assert (shown.var(0).argsort() == [2, 0, 1]).all()
    unit = mean / np.sqrt((mean**2).sum(1).mean())
    np.testing.assert_allclose(align(shown, unit).aligned, unit, atol=1e-3)


def test_one_frame_has_no_modes_but_a_mean() -> None:
    space = shape_space(
        model(KeypointLayout.numbered(P)), lifted(np.random.default_rng(5).random((1, P, 3)))
    )
    assert np.isfinite(space.mean).all() and (np.abs(space.modes) < 1e-6).all()
