# SPDX-License-Identifier: Apache-2.0
"""A table with 3D points is refused; MediaPipe's z beside pixels is none."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from deep_nrsfm_ros.data.formats.builder import KeypointFileError
from deep_nrsfm_ros.data.formats.depth_check import DepthCheck

RNG = np.random.default_rng(0)
BODY = RNG.uniform(-1, 1, (33, 3)) * [0.3, 0.9, 0.2]


def is_3d(scale: object, shift: object, body: NDArray[np.float64] = BODY, **options: bool) -> bool:
    check = DepthCheck([f"p{i}" for i in range(len(body))], **{"has_confidence": False, **options})
    for step in range(20):
        check.add((body + [0.01 * step, 0, 0]) * np.asarray(scale) + np.asarray(shift))
    try:
        check.finish()
    except KeypointFileError as error:
        assert str(error).startswith("it is 3D (z changes: z of p0 is ")
        return True
    return False


@pytest.mark.parametrize("has_confidence", [False, True])
def test_three_dimensions(has_confidence: bool) -> None:
    for scale, shift in (
        (1, (0, 0, 3)),  # metres before a camera
        (1000, (0, 0, 3000)),
        (1000, (2000, 1400, 900)),  # markers, z up
        (1, 0),  # relative to the hips, as MediaPipe's world landmarks
    ):
        assert is_3d(scale, shift, has_confidence=has_confidence)


@pytest.mark.parametrize("has_confidence", [False, True])
def test_the_z_of_mediapipe(has_confidence: bool) -> None:
    assert not is_3d((0.3, 0.3, 0.5), (0.5, 0.5, 0), has_confidence=has_confidence)
    assert not is_3d((300, 300, 400), (500, 400, 0), has_confidence=has_confidence)
    assert not is_3d((300, 300, 0), (500, 400, 0), has_confidence=has_confidence)
    hand = np.concatenate([np.zeros((1, 3)), RNG.uniform((-1, -1, -1), (1, 1, 0), (20, 3))])
    assert not is_3d((0.1, 0.1, 0.1), (0.5, 0.5, 0), hand, has_confidence=has_confidence)


def test_some_landmarks_of_mediapipe() -> None:
    """Without the hips, all of z may be negative."""
    upper = BODY[:10] - [0, 0, 1]
    for scale, shift in (((0.3, 0.3, 0.5), (0.5, 0.5, 0)), ((300, 300, 400), (500, 400, 0))):
        assert not is_3d(scale, shift, upper, has_confidence=True, has_visibility=True)
        assert is_3d(scale, shift, upper, has_confidence=True)
    assert is_3d(1, (0, 0, 3), upper, has_confidence=True, has_visibility=True)


def test_it_is_said_before_the_end() -> None:
    check = DepthCheck(["nose", "tail"], has_confidence=False)
    xyz = np.array([[10.0, 20, 900], [30, 40, 950]])
    for _ in range(499):
        check.add(xyz)
    with pytest.raises(KeypointFileError, match="it is 3D"):
        check.add(xyz)
