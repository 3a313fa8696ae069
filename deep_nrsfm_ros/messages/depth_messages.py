# SPDX-License-Identifier: Apache-2.0
"""Depth of pixels from sensor_msgs/Image, PointCloud2 and Range; ROS is not imported."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.observation import MessageError
from deep_nrsfm_ros.messages.field_mapping import Size

Floats = NDArray[Any]

ENCODINGS = {"16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3), "32FC1": ("f4", 1.0)}
"""Encoding of a depth image -> format of a pixel, metres of its unit."""
_FLOATS = {7: "f4", 8: "f8"}  # sensor_msgs/PointField datatypes FLOAT32 and FLOAT64
_WINDOW = 2  # pixels on each side of a keypoint: 5 x 5 are read
_MIN_SHARE = 0.2  # of a window that must have a depth
_CONE = 0.015  # rad around a keypoint's ray within which points of a sparse cloud are its own
_MAX_PIXEL = 1e6  # a projection farther out is in no image


class DepthImage:
    """Depth of each pixel of an image, as the bytes of a message have it."""

    def __init__(self, values: Floats, unit: float) -> None:
        """Keep the depths.

        Args:
            values: (height, width) view of the message's bytes; 0 and NaN: a hole.
            unit: of the values in metres.
        """
        self._values, self._unit = values, unit

    def at(self, pixels: Floats) -> Floats:
        """Return the depth (...,) in metres at pixels (..., 2), NaN in holes and outside."""
        at = window(pixels)
        height, width = self._values.shape
        inside = ((at >= 0) & (at < (width, height))).all(-1)
        columns, rows = (np.where(inside, at[..., i], 0) for i in range(2))
        values = self._values[rows, columns].astype(np.float64) * self._unit
        return window_depth(np.where(inside, values, np.nan))


class DepthPoints:
    """Points in the frame of the camera, in any order."""

    def __init__(self, points: Floats, intrinsics: Intrinsics) -> None:
        """Project the points.

        Args:
            points: (m, 3) in metres in the optical frame; NaN: none.
            intrinsics: of the camera.
        """
        with np.errstate(all="ignore"):
            ahead = np.isfinite(points).all(1) & (points[:, 2] > 0)
            points = points[ahead].astype(np.float64)
            pixels = intrinsics.pixels(points[:, :2] / points[:, 2:])
        order = np.argsort(pixels[:, 0])
        self._columns, self._rows = pixels[order].T
        self._depth = points[order, 2]
        self._radius = _CONE * max(intrinsics.focal)

    def at(self, pixels: Floats) -> Floats:
        """Return the depth (...,) in metres at pixels (..., 2), NaN without points near them."""
        flat = pixels.reshape(-1, 2)
        depth = np.full(len(flat), np.nan)
        first = np.searchsorted(self._columns, flat[:, 0] - self._radius)
        last = np.searchsorted(self._columns, flat[:, 0] + self._radius, "right")
        for i, (start, end) in enumerate(zip(first.tolist(), last.tolist(), strict=True)):
            near = np.abs(self._rows[start:end] - flat[i, 1]) <= self._radius
            if near.any():
                depth[i] = np.median(self._depth[start:end][near])
        return depth.reshape(pixels.shape[:-1])


def window(pixels: Floats) -> NDArray[np.int64]:
    """Return the pixels (..., w, 2), columns and rows, of the windows around pixels (..., 2)."""
    steps = np.arange(-_WINDOW, _WINDOW + 1)
    around = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    usable = np.where(np.abs(pixels) < _MAX_PIXEL, pixels, -_MAX_PIXEL)  # NaN compares false
    windows: NDArray[np.int64] = np.rint(usable)[..., None, :].astype(np.int64) + around
    return windows


def window_depth(values: Floats) -> Floats:
    """Return the median depth (...,) of windows (..., w); NaN where most of it are holes."""
    with np.errstate(invalid="ignore"):
        usable = (values > 0) & np.isfinite(values)
    ordered = np.sort(np.where(usable, values, np.inf), -1)
    count = usable.sum(-1)
    middle = np.maximum(count - 1, 0) // 2
    median = np.take_along_axis(ordered, middle[..., None], -1)[..., 0]
    return np.where(count >= _MIN_SHARE * values.shape[-1], median, np.nan)


def read_depth_image(message: Any, size: Size | None) -> DepthImage:
    """Return the depths of a sensor_msgs/Image, without a copy.

    Args:
        message: an Image of rclpy or rosbags.
        size: width and height of the camera's image; None: unknown.

    Raises:
        MessageError: another encoding or size, or too few bytes.
    """
    known = ENCODINGS.get(message.encoding)
    if known is None:
        raise MessageError(
            f"encoding is {message.encoding!r}; expected 16UC1 (millimetres) or 32FC1 (metres): "
            "name the topic of the depth image, not that of the colour image or a compressed one"
        )
    height, width, step = int(message.height), int(message.width), int(message.step)
    if size is not None and (width, height) != tuple(size):
        raise MessageError(
            f"depth image is {width} x {height} and the camera's image {size[0]} x {size[1]}: "
            "the depth must be registered to the image of the keypoints (depth aligned to colour)"
        )
    form, unit = known
    form = (">" if message.is_bigendian else "<") + form
    pixel = np.dtype(form).itemsize
    values = _array(message.data, form, (height, width), (step, pixel), 0)
    return DepthImage(values, unit)


def read_depth_points(
    message: Any, size: Size | None, intrinsics: Intrinsics
) -> DepthImage | DepthPoints:
    """Return the depths of a sensor_msgs/PointCloud2 in the camera's optical frame.

    A cloud with the size of the image has a point for each pixel; another is projected.

    Args:
        message: a PointCloud2 of rclpy or rosbags.
        size: width and height of the camera's image; None: unknown.
        intrinsics: of the camera.

    Raises:
        MessageError: x, y or z is missing or no float, or there are too few bytes.
    """
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    row_step = int(message.row_step) if height > 1 else width * step
    order = ">" if message.is_bigendian else "<"
    fields = {field.name: field for field in message.fields}
    columns = []
    for name in "xyz":
        form = _FLOATS.get(int(fields[name].datatype)) if name in fields else None
        if form is None:
            raise MessageError(
                f"the cloud has no float field {name!r}; its fields are: "
                f"{', '.join(map(str, [*fields][:20])) or 'none'}"
            )
        offset, strides = int(fields[name].offset), (row_step, step)
        columns.append(_array(message.data, order + form, (height, width), strides, offset))
    if height > 1 and (size is None or (width, height) == tuple(size)):
        return DepthImage(columns[2], 1.0)
    return DepthPoints(np.stack([column.reshape(-1) for column in columns], 1), intrinsics)


def read_range(message: Any) -> tuple[float, float]:
    """Return distance and beam of a sensor_msgs/Range.

    Args:
        message: a Range of rclpy or rosbags.

    Returns:
        The distance in metres, NaN without an echo, and half the field of view in radians.
    """
    distance, view = float(message.range), float(message.field_of_view)
    low, high = max(float(message.min_range), 0.0), float(message.max_range) or np.inf
    echo = low < distance < high
    return distance if echo else np.nan, view / 2 if 0 < view < np.pi else 0.0


def _array(
    data: Any, form: str, shape: tuple[int, int], strides: tuple[int, int], offset: int
) -> Floats:
    """Return a view of a message's bytes; raise MessageError if they are too few."""
    raw = memoryview(data).cast("B")
    item = np.dtype(form).itemsize
    (height, width), (row, column) = shape, strides
    if not height or not width:
        raise MessageError("it is empty")
    needed = offset + (height - 1) * row + (width - 1) * column + item
    if column < offset + item or row < width * column or raw.nbytes < needed:
        raise MessageError(
            f"{height} x {width} of {column} bytes in rows of {row} do not fit into the "
            f"{raw.nbytes} bytes of its data"
        )
    return np.ndarray(shape, form, raw, offset, strides)
