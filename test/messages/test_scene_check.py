# SPDX-License-Identifier: Apache-2.0
"""Gravity, heights and keypoints that people contradict, and scenes in which they do not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from deep_nrsfm_ros.messages.scene_check import (
    WINDOW,
    FloorCheck,
    GravityCheck,
    WrongKeypointCheck,
)

LEVEL = np.array([0.0, -1, 0])
DOWN, FORWARD = -LEVEL, np.array([0.0, 0, 1])


def camera_up(pitch: float, roll: float = 0.0) -> np.ndarray:
    """Return the direction against gravity before a camera that looks down by `pitch` degrees."""
    return Rotation.from_euler("xz", [pitch, roll], degrees=True).apply(LEVEL)


def people(axis: np.ndarray, n: int, seed: int = 0) -> np.ndarray:
    """Return rotations (n, 3, 3) of people with an up axis, 8 degrees off, and any front."""
    rng = np.random.default_rng(seed)
    turn, _ = Rotation.align_vectors([axis], [[0, 0, 1.0]])
    lean = Rotation.from_rotvec(np.radians(8) * rng.standard_normal((n, 3)))
    about = Rotation.from_rotvec(rng.uniform(0, 6, (n, 1)) * [[0, 0, 1.0]])
    return np.asarray((lean * turn * about).as_matrix(), np.float32)


def codes(axes: np.ndarray | list[np.ndarray], up: np.ndarray, seconds: float = 8.0) -> list[str]:
    """Return what is found of people with one of some up axes in turn, at 4 Hz."""
    check, axes = GravityCheck(), np.atleast_2d(axes)
    for i in range(int(4 * seconds)):
        check.add(i / 4, people(axes[i // 4 % len(axes)], 1, i), up)
    return [finding.code for finding in check.find("gravity.up", "check it")]


@pytest.mark.parametrize("up", [DOWN, FORWARD, camera_up(170), camera_up(-95)])
@pytest.mark.parametrize("pitch", [-10, 0, 25])
def test_a_wrong_direction_is_found(up: np.ndarray, pitch: float) -> None:
    assert codes(camera_up(pitch), up) == ["gravity"]


def test_the_message_has_angle_source_and_mend() -> None:
    check = GravityCheck()
    for i in range(30):
        check.add(i / 4, people(LEVEL, 4, i), DOWN)
        check.add(i / 4 + 0.01, people(DOWN, 50), LEVEL)  # too soon after the one before
    (finding,) = check.find("gravity.up", "check its sign")
    angle = int(str(finding).split(", and ")[1].split()[0])
    assert 165 <= angle <= 180 and "that gravity.up gives: check its sign" in str(finding)
    check.forget()
    assert not check.find("gravity.up", "")


@pytest.mark.parametrize("pitch", [-40, -20, 0, 20, 40, 60, 90])
@pytest.mark.parametrize("roll", [0, 90, 180])
def test_right_directions_are_silent(pitch: float, roll: float) -> None:
    up = camera_up(pitch, roll)
    assert not codes(up, up)  # people who stand
    across = np.linalg.svd(up[None])[2][1:]
    for angle in np.radians(range(0, 360, 45)):  # people who lie on the floor
        assert not codes(np.cos(angle) * across[0] + np.sin(angle) * across[1], up)


def test_who_bends_or_stands_on_the_head_for_a_while_is_no_finding() -> None:
    assert not codes([LEVEL, camera_up(90), LEVEL, DOWN], LEVEL, WINDOW)
    assert not codes(DOWN, LEVEL)  # upside down in the image too, which is a finding of its own


def test_a_moment_and_nobody_are_no_finding() -> None:
    assert not codes(LEVEL, DOWN, 3.0)
    check = GravityCheck()
    for i in range(100):
        check.add(i / 10, np.full((2, 3, 3), np.nan, np.float32), DOWN)
    assert not check.find("gravity.up", "")
    for i in range(10):  # people of long ago do not count
        check.add(100 * i, people(LEVEL, 30), DOWN)
    assert not check.find("gravity.up", "")


BELIEVED = (0.4, 1.3)


def sizes(*factors: float) -> FloorCheck:
    """Return a check of 10 s of objects with these factors in each message."""
    check = FloorCheck()
    for i in range(40):
        assert check.is_due(i / 4)
        check.add(i / 4, np.array(factors), BELIEVED)
        assert not check.is_due(i / 4 + 0.1) or np.isnan(factors).all()
    return check


@pytest.mark.parametrize(
    ("factor", "trunk", "said"),
    [
        (2.12, 0.5, "people on that floor would have a trunk of 1.06 m (0.2 to 0.65 m exist); "),
        (0.2, 0.5, "have a trunk of 0.10 m"),
        (3.0, None, "would be 3 times as large as reference_length says (0.4 to 1.3 are believed)"),
        (np.inf, 0.5, "objects are higher than the camera; check it, the direction of gravity"),
    ],
)
def test_sizes_that_do_not_exist_are_found(factor: float, trunk: float | None, said: str) -> None:
    (finding,) = sizes(factor, np.nan).find(2.2, trunk)
    assert finding.code == "floor" and said in str(finding)
    assert str(finding).startswith("camera_height is 2.2 and is not used: ")


def test_some_impossible_sizes_are_no_finding() -> None:
    assert not sizes(1.0, 1.29, 0.41).find(1.4, 0.5)
    assert not sizes(1.0, *[9.0] * 4).find(1.4, 0.5)  # hidden feet, somebody on a balcony
    assert not sizes(np.nan).find(1.4, 0.5)
    check = sizes(9.0)
    check.forget()
    assert not check.find(1.4, 0.5)


def test_a_keypoint_that_is_wrong_for_seconds_is_found() -> None:
    check, wrong = WrongKeypointCheck(), np.array([[False, True], [True, True]])
    residual = np.array([0.2, np.nan], np.float32)  # the second object is not lifted
    assert check.text("ab") == "none" and not check.find("ab")
    for i in range(40):
        check.add(i / 4, wrong & (i % 2 == 0), residual)
        check.add(i / 4 + 0.01, wrong, residual)  # too soon after the last one
    (finding,) = check.find("ab")
    assert finding.code == "wrong-keypoint" and "keypoint 'b' contradicts" in str(finding)
    assert check.text("ab") == "b 50%"
    check.forget()
    assert check.text("ab") == "none" and not check.find("ab")
