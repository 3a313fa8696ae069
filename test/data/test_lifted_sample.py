# SPDX-License-Identifier: Apache-2.0
"""The sample of frames that a model lifts."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.lifted_sample import lift_sample
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser

P = 10


def model(layout: KeypointLayout) -> Model:
    net = initialise(Architecture(widths=(8, 4)), len(layout), np.random.default_rng(0))
    return Model("mine", net, layout, Normaliser(), np.eye(3, dtype=np.float32))


def frames(f: int, p: int) -> Dataset:
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 500, (f, p, 2)).astype(np.float32)
    return Dataset(points, rng.random((f, p)) < 0.9, KeypointLayout.numbered(p), "made up")


def test_frames_that_cannot_be_lifted_are_passed_over() -> None:
    seen = frames(30, P)
    seen.visible[::3] = False
    found = lift_sample(model(seen.layout), seen)
    assert found.frames.tolist() == [i for i in range(30) if i % 3]
    assert all(np.isfinite(array).all() for array in found.lifted)
    seen.visible[:] = False
    with pytest.raises(ValueError, match="lifts none of the 30 frames"):
        lift_sample(model(seen.layout), seen)


def test_a_sample_is_spread_evenly() -> None:
    found = lift_sample(model(KeypointLayout.numbered(P)), frames(100, P), most=5)
    assert found.frames.tolist() == [0, 24, 49, 74, 99]
