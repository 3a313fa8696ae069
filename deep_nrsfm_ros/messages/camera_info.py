"""sensor_msgs/CameraInfo to intrinsics, by duck typing: nothing of ROS is imported."""

from __future__ import annotations

from typing import Any

from deep_nrsfm_ros.lifting.intrinsics import COEFFICIENTS, EQUIDISTANT, PLUMB_BOB, Intrinsics
from deep_nrsfm_ros.lifting.observation import MessageError


def read_camera_info(message: Any, *, rectified: bool = False) -> Intrinsics:
    """Return the intrinsics of the image that a CameraInfo belongs to.

    rectified: of the rectified image (the matrix P, no distortion) rather than the raw one (K
    and D). A region of interest and binning are taken into account.
    Raises MessageError for an uncalibrated camera and for what no camera has.
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
        raise MessageError(f"{name} is zero: the camera is not calibrated; calibrate it")
    if rectified or (lens != EQUIDISTANT and not any(distortion)):
        lens, distortion = PLUMB_BOB, []
    if lens not in COEFFICIENTS:
        raise MessageError(
            f"distortion_model is {lens!r}; expected one of {', '.join(COEFFICIENTS)}: rectify "
            "the image and set rectified"
        )
    # OpenCV's later coefficients (thin prism, tilt) are mostly sent as zeros.
    most = max(COEFFICIENTS[lens])
    if not any(distortion[most:]):
        distortion = distortion[:most]
    focal = (matrix[0] / bin_x, matrix[columns + 1] / bin_y)
    principal = ((matrix[2] - left) / bin_x, (matrix[columns + 2] - top) / bin_y)
    try:
        return Intrinsics(focal, principal, tuple(distortion), lens)
    except ValueError as error:
        raise MessageError(str(error)) from None
