"""Where the keypoints are in the data of a sensor_msgs/PointCloud2."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.observation import MessageError, check_keypoints

_FLOATS = {7: "f4", 8: "f8"}  # sensor_msgs/PointField datatypes FLOAT32 and FLOAT64


class PointCloudFormat(NamedTuple):
    """All of a PointCloud2 that tells how to read its data; most messages of a topic share it.

    height, width: objects and keypoints. formats, offsets: of x, y and, where there is one,
    confidence, in numpy's words and in bytes from the beginning of a point. row_step, point_step:
    bytes from one object, and from one keypoint, to the next.
    """

    height: int
    width: int
    formats: tuple[str, ...]
    offsets: tuple[int, ...]
    row_step: int
    point_step: int

    @property
    def is_float32(self) -> bool:
        """Tell whether all numbers are little-endian float32."""
        return set(self.formats) == {"<f4"}

    def values(
        self, data: bytes | memoryview, start: int = 0, messages: int = 1, apart: int = 0
    ) -> NDArray[np.float32]:
        """Return (messages * height, width, 2 or 3: x, y, confidence) of messages of this make.

        data: holds theirs, the first from the byte `start` on, each next one `apart` bytes later.
        """
        shape = (messages, self.height, self.width)
        steps = (apart, self.row_step, self.point_step)
        values = np.empty((len(self.formats), *shape), np.float32)
        if self.height:
            with np.errstate(over="ignore", invalid="ignore"):  # any bytes may come
                for i, form in enumerate(self.formats):
                    values[i] = np.ndarray(shape, form, data, start + self.offsets[i], steps)
        together = (len(values), messages * self.height, self.width)
        return values.reshape(together).transpose(1, 2, 0)


def point_cloud_format(message: Any, keypoints: int) -> PointCloudFormat:
    """Return what a PointCloud2 says of its data, once that is found to hold `keypoints` points.

    Raises MessageError where it does not.
    """
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    check_keypoints(width, keypoints, "width")
    names = ["x", "y"] + ["confidence"] * any(f.name == "confidence" for f in message.fields)
    formats, offsets = zip(*(_field(message.fields, name, step) for name in names), strict=True)
    order = ">" if message.is_bigendian else "<"
    formats = tuple(order + form for form in formats)
    row_step = int(message.row_step) if height > 1 else width * step
    make = PointCloudFormat(height, width, formats, offsets, row_step, step)
    if not height:
        return make
    if row_step < width * step:
        raise MessageError(
            f"row_step is {row_step}; {width} points of {step} bytes need at least {width * step}"
        )
    size = memoryview(message.data).nbytes
    needed = (height - 1) * row_step + width * step
    if size < needed:
        raise MessageError(f"data has {size} bytes; {height} x {width} points need {needed}")
    return make


def _field(fields: Sequence[Any], name: str, point_step: int) -> tuple[str, int]:
    """Return (numpy format, offset) of the field called `name`, checked to lie in a point."""
    found = [field for field in fields if field.name == name]
    if len(found) != 1:
        names = ", ".join(str(field.name) for field in fields[:20]) or "none"
        raise MessageError(f"expected one field {name!r}; the fields are: {names}")
    form = _FLOATS.get(int(found[0].datatype))
    if form is None:
        raise MessageError(
            f"field {name!r} has datatype {found[0].datatype}; expected FLOAT32 (7) or FLOAT64 (8)"
        )
    offset = int(found[0].offset)
    if offset < 0 or offset + int(form[1]) > point_step:
        raise MessageError(
            f"field {name!r} at offset {offset} does not fit into a point_step of {point_step}"
        )
    return form, offset
