# SPDX-License-Identifier: Apache-2.0
"""The memory layout of keypoints in the data of a sensor_msgs/PointCloud2."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.observation import MessageError, check_keypoints

CONFIDENCE = "confidence"
"""Name of the field with the confidence of keypoints."""

_LIKE_CONFIDENCE = re.compile(r"(?i)conf|scor|prob|likel|certain|visib|^[cps]$")
_FLOATS = {7: "f4", 8: "f8"}  # sensor_msgs/PointField datatypes FLOAT32 and FLOAT64


class PointCloudFormat(NamedTuple):
    """Memory layout of the data of a PointCloud2; most messages of a topic share it.

    Attributes:
        height: number of objects.
        width: number of keypoints.
        formats: NumPy formats of x, y and, if there is one, confidence.
        offsets: their bytes from the beginning of a point.
        row_step: bytes from one object to the next.
        point_step: bytes from one keypoint to the next.
    """

    height: int
    width: int
    formats: tuple[str, ...]
    offsets: tuple[int, ...]
    row_step: int
    point_step: int

    @property
    def is_float32(self) -> bool:
        """Whether all numbers are little-endian float32."""
        return set(self.formats) == {"<f4"}

    def values(
        self, data: bytes | memoryview, start: int = 0, messages: int = 1, stride: int = 0
    ) -> NDArray[np.float32]:
        """Return x, y and, if there is one, confidence of all points of some messages.

        Args:
            data: bytes of all messages.
            start: first byte of the first message's data.
            messages: number of messages.
            stride: bytes from the data of one message to the data of the next.

        Returns:
            (messages * height, width, 2 or 3).
        """
        shape = (messages, self.height, self.width)
        strides = (stride, self.row_step, self.point_step)
        values = np.empty((len(self.formats), *shape), np.float32)
        if self.height:
            with np.errstate(over="ignore", invalid="ignore"):  # the bytes may be any
                for i, form in enumerate(self.formats):
                    values[i] = np.ndarray(shape, form, data, start + self.offsets[i], strides)
        flat = (len(values), messages * self.height, self.width)
        return values.reshape(flat).transpose(1, 2, 0)


def point_cloud_format(message: Any, keypoints: int) -> PointCloudFormat:
    """Return the memory layout of a PointCloud2, checked against the size of its data.

    Args:
        message: a PointCloud2 of rclpy or rosbags.
        keypoints: number of keypoints of the detector's layout.

    Raises:
        MessageError: another number of keypoints, a missing field, or too little data.
    """
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    if not width:  # nobody is there: an empty cloud may have any height
        height, width = 0, keypoints
    if width != keypoints and (height == keypoints or height == 1 and not width % keypoints):
        raise MessageError(
            f"width is {width} and height {height}; width is the number of keypoints, which is "
            f"{keypoints}, and height that of objects: send {width * height // keypoints or 1} x "
            f"{keypoints}"
        )
    check_keypoints(width, keypoints, "width")
    names = ["x", "y"] + [CONFIDENCE] * any(f.name == CONFIDENCE for f in message.fields)
    formats, offsets = zip(*(_field(message.fields, name, step) for name in names), strict=True)
    order = ">" if message.is_bigendian else "<"
    formats = tuple(order + form for form in formats)
    row_step = int(message.row_step) if height > 1 else width * step
    cloud = PointCloudFormat(height, width, formats, offsets, row_step, step)
    if not height:
        return cloud
    if row_step < width * step:
        raise MessageError(
            f"row_step is {row_step}; {width} points of {step} bytes need at least {width * step}"
        )
    size = memoryview(message.data).nbytes
    needed = (height - 1) * row_step + width * step
    if size < needed:
        raise MessageError(f"data has {size} bytes; {height} x {width} points need {needed}")
    return cloud


def unused_confidence(message: Any) -> str:
    """Return the field of a PointCloud2 that may be meant as confidence, and is not read.

    Args:
        message: a PointCloud2 of rclpy or rosbags.

    Returns:
        Its name; "" if there is none, or a field `confidence`.
    """
    names = [str(field.name) for field in message.fields]
    if CONFIDENCE in names:
        return ""
    return next((name for name in names if _LIKE_CONFIDENCE.search(name)), "")


def _field(fields: Sequence[Any], name: str, point_step: int) -> tuple[str, int]:
    """Return NumPy format and offset of the field `name`, checked to lie within a point."""
    named = [field for field in fields if field.name == name]
    if len(named) != 1:
        names = ", ".join(str(field.name) for field in fields[:20]) or "none"
        raise MessageError(f"expected one field {name!r}; the fields are: {names}")
    form = _FLOATS.get(int(named[0].datatype))
    if form is None:
        raise MessageError(
            f"field {name!r} has datatype {named[0].datatype}; expected FLOAT32 (7) or FLOAT64 (8)"
        )
    offset = int(named[0].offset)
    if offset < 0 or offset + int(form[1]) > point_step:
        raise MessageError(
            f"field {name!r} at offset {offset} does not fit into a point_step of {point_step}"
        )
    return form, offset
