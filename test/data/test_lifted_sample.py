# SPDX-License-Identifier: Apache-2.0
"""The sample of frames that a model lifts."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.data.lifted_sample import lift_sample
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from test.fixtures.random_model import random_frames, random_model

P = 10


def test_frames_that_cannot_be_lifted_are_passed_over() -> None:
    seen = random_frames(30, P)
    seen.visible[::3] = False
    found = lift_sample(random_model(seen.layout), seen)
    assert found.frames.tolist() == [i for i in range(30) if i % 3]
    assert all(np.isfinite(array).all() for array in found.lifted)
    seen.visible[:] = False
    with pytest.raises(ValueError, match="lifts none of the 30 frames"):
        lift_sample(random_model(seen.layout), seen)


def test_a_sample_is_spread_evenly() -> None:
    found = lift_sample(random_model(KeypointLayout.numbered(P)), random_frames(100, P), most=5)
    assert found.frames.tolist() == [0, 24, 49, 74, 99]
