# SPDX-License-Identifier: Apache-2.0
"""Read the intrinsics from a sensor_msgs/CameraInfo, by duck typing: ROS is not imported."""

from __future__ import annotations

from typing import Any

from deep_nrsfm_ros.lifting.intrinsics import COEFFICIENTS, EQUIDISTANT, PLUMB_BOB, Intrinsics
from deep_nrsfm_ros.lifting.observation import MessageError


def read_camera_info(message: Any, *, rectified: bool = False) -> Intrinsics:
    """Return the intrinsics of the image that a CameraInfo describes.

    A region of interest and binning are taken into account.

    Args:
        message: a CameraInfo of rclpy or rosbags.
        rectified: True: of the rectified image (matrix P, no distortion); False: of the raw image
            (K and D).

    Raises:
        MessageError: the camera is not calibrated, or its numbers are not those of a camera.
    """
    try:
        matrix = [float(value) for value in (message.p if rectified else message.k)]
        distortion = [float(value) for value in message.d]
        lens = str(message.distortion_model)
        bin_x, bin_y = max(int(message.binning_x), 1), max(int(message.binning_y), 1)
        left, top = float(message.roi.x_offset), float(message.roi.y_offset)
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise MessageError(f"expected a message of type sensor_msgs/CameraInfo: {error}") from None
    name, columns = ("p", 4) if rectified else ("k", 3)
    if len(matrix) != 3 * columns:
        raise MessageError(f"{name} has {len(matrix)} numbers; expected {3 * columns}")
    if not matrix[0]:
        if rectified and message.k[0]:
            raise MessageError(
                "p is zero, though k is not: the camera is calibrated, and not for a rectified "
                "image; leave rectified out, or have the driver fill p"
            )
        raise MessageError(f"{name} is zero: the camera is not calibrated; calibrate it")
    if rectified or (lens != EQUIDISTANT and not any(distortion)):
        lens, distortion = PLUMB_BOB, []
    if lens not in COEFFICIENTS:
        raise MessageError(
            f"distortion_model is {lens!r}; expected one of {', '.join(COEFFICIENTS)}: rectify "
            "the image and set rectified"
        )
    # OpenCV's further coefficients (thin prism, tilt) are not modelled; most drivers send zeros.
    count = max(COEFFICIENTS[lens])
    if not any(distortion[count:]):
        distortion = distortion[:count]
    focal = (matrix[0] / bin_x, matrix[columns + 1] / bin_y)
    principal = ((matrix[2] - left) / bin_x, (matrix[columns + 2] - top) / bin_y)
    try:
        return Intrinsics(focal, principal, tuple(distortion), lens)
    except ValueError as error:
        raise MessageError(str(error)) from None
