# SPDX-License-Identifier: Apache-2.0
"""CameraInfo becomes intrinsics; what is wrong with it is said."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.lifting.intrinsics import EQUIDISTANT, PLUMB_BOB, RATIONAL, Intrinsics
from deep_nrsfm_ros.lifting.observation import MessageError
from deep_nrsfm_ros.messages.camera_info import read_camera_info


def info(**changes: Any) -> SimpleNamespace:
    fields = {
        "k": np.array([600, 0, 320, 0, 610, 236, 0, 0, 1.0]),
        "p": np.array([580, 0, 315, 0, 0, 590, 240, 0, 0, 0, 1.0, 0]),
        "d": [-0.28, 0.09, 0.0008, -0.0005, -0.012],
        "distortion_model": PLUMB_BOB,
        "binning_x": 0,
        "binning_y": 0,
        "roi": SimpleNamespace(x_offset=0, y_offset=0),
    }
    return SimpleNamespace(**fields | changes)


def test_raw_and_rectified() -> None:
    assert read_camera_info(info()) == Intrinsics((600, 610), (320, 236), tuple(info().d))
    assert read_camera_info(info(), rectified=True) == Intrinsics((580, 590), (315, 240))


def test_binning_and_region_as_the_message_defines_them() -> None:
    part = info(binning_x=2, binning_y=4, roi=SimpleNamespace(x_offset=20, y_offset=36))
    found = read_camera_info(part)
    assert (found.focal, found.principal) == ((300, 152.5), (150, 50))


@pytest.mark.parametrize(
    ("model", "coefficients", "expected"),
    [
        ("", [], Intrinsics((600, 610), (320, 236))),
        ("whatever", [0.0] * 5, Intrinsics((600, 610), (320, 236))),
        (
            RATIONAL,
            [*range(1, 9), 0.0, 0, 0, 0, 0, 0],
            Intrinsics((600, 610), (320, 236), tuple(map(float, range(1, 9))), RATIONAL),
        ),
        (EQUIDISTANT, [0.0] * 4, Intrinsics((600, 610), (320, 236), (0.0,) * 4, EQUIDISTANT)),
    ],
)
def test_lenses_as_drivers_send_them(
    model: str, coefficients: list[float], expected: Intrinsics
) -> None:
    assert read_camera_info(info(distortion_model=model, d=coefficients)) == expected


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (info(k=np.zeros(9)), "k is zero: the camera is not calibrated"),
        (info(k=np.ones(4)), "k has 4 numbers; expected 9"),
        (info(k=np.full(9, np.nan)), "not finite"),
        (info(distortion_model="fov", d=[0.9]), "'fov'; expected one of plumb_bob.*set rectified"),
        (info(d=[1.0, 2, 3]), "has 3 coefficients"),
        (info(distortion_model=RATIONAL, d=[1.0] * 12), "has 12 coefficients"),
        (info(binning_x=np.inf), "expected a message of type sensor_msgs/CameraInfo"),
        (SimpleNamespace(), "expected a message of type sensor_msgs/CameraInfo"),
    ],
)
def test_what_cannot_be_used_is_said(message: Any, reason: str) -> None:
    with pytest.raises(MessageError, match=reason):
        read_camera_info(message)
