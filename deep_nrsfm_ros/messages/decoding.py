# SPDX-License-Identifier: Apache-2.0
"""Read observations from decoded keypoint messages, by duck typing: ROS is not imported.

Live messages of rclpy and messages that rosbags reads from a bag have the same fields and take the
same path. Every malformed message raises `MessageError`, before memory of a size that the message
claims is allocated.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.observation import (
    NAME_THE_LAYOUT,
    MessageError,
    Observation,
    check_keypoints,
    to_observation,
)
from deep_nrsfm_ros.messages.field_mapping import MAPPINGS, PIXELS, FieldMapping, Size
from deep_nrsfm_ros.messages.mapping_file import MAPPING_SUFFIXES, read_mapping
from deep_nrsfm_ros.messages.point_cloud import point_cloud_format

POINT_CLOUD = "sensor_msgs/PointCloud2"
MULTI_ARRAY = "std_msgs/Float32MultiArray"
POLYGON = "geometry_msgs/PolygonStamped"

POINT_FIELDS = (("x", 0), ("y", 4), ("z", 8), ("confidence", 12))
"""Name and offset in bytes of the float32 fields of the lifter's PointCloud2."""
POINT_STEP = 16
"""Bytes of a point of the lifter's PointCloud2."""

InputType = str | FieldMapping
"""One of `INPUT_TYPES`, or the field mapping of any other type."""


def resolve_input_type(option: str, word: str) -> InputType:
    """Return the input type that the value of an option names.

    Args:
        option: name of the option, for the error text.
        word: one of `INPUT_TYPES`, or the path of a field mapping.

    Raises:
        ValueError: `word` is neither, or the file is invalid.
    """
    name = word.replace("/msg/", "/")
    if name in INPUT_TYPES:
        return name
    if word.endswith(MAPPING_SUFFIXES):
        return read_mapping(Path(word).expanduser())
    raise ValueError(
        f"{option} is {word!r}; name one of {', '.join(INPUT_TYPES)}, or for any other type the "
        f"path of a field mapping ({MAPPING_SUFFIXES[0]})"
    )


def type_name(input_type: InputType) -> str:
    """Return the name of the message type, "package/Type"."""
    return input_type if isinstance(input_type, str) else input_type.type


def implied_layout(input_type: InputType) -> str:
    """Return the name of the preset in which messages of a type are by definition; "" if none."""
    return _IMPLIED.get(input_type, "") if isinstance(input_type, str) else ""


def read_observation(
    message: Any,
    input_type: InputType,
    keypoints: int,
    min_confidence: float = 0.0,
    size: Size | None = None,
) -> Observation:
    """Return the objects in a message.

    Args:
        message: of rclpy or rosbags.
        input_type: type of the message.
        keypoints: q, the number of keypoints of the detector's layout.
        min_confidence: in [0, 1]; a keypoint with less is missing, see `to_observation`.
        size: width and height of the image; needed for normalised keypoints.

    Raises:
        MessageError: the message is malformed or has another number of keypoints.
        ValueError: `input_type` is unknown.
    """
    mapping = _mapping(input_type)
    try:
        if mapping:
            mapped = mapping(message, keypoints, size)
            observation = to_observation(mapped.values, min_confidence, mapped.identities)
            return observation._replace(
                scores=mapped.scores, left_out=mapped.left_out, places=mapped.places
            )
        if isinstance(input_type, str) and (reader := _READERS.get(input_type)):
            return to_observation(reader(message, keypoints), min_confidence)
    except MessageError:
        raise
    except (AttributeError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise MessageError(f"expected a message of type {type_name(input_type)}: {error}") from None
    raise ValueError(f"no input type {input_type!r}; choose one of {', '.join(INPUT_TYPES)}")


def is_normalised(input_type: InputType) -> bool:
    """Return whether messages of a type give fractions of the image, or of a scaled one."""
    mapping = _mapping(input_type)
    return mapping is not None and mapping.units != PIXELS


def read_confidence(
    message: Any, input_type: InputType, keypoints: int, size: Size | None = None
) -> NDArray[np.floating]:
    """Return the confidence (n, q) of the keypoints in a message as the detector gives it.

    Args:
        message: as in `read_observation`.
        input_type: as in `read_observation`.
        keypoints: as in `read_observation`.
        size: as in `read_observation`.

    Raises:
        Exception: the message is malformed, or `input_type` is unknown.
    """
    mapping = _mapping(input_type)
    values = (
        mapping(message, keypoints, size).values
        if mapping
        else _READERS[str(input_type)](message, keypoints)
    )
    return values[..., 2] if values.shape[-1] == 3 else np.ones(values.shape[:2])


def count_keypoints(message: Any, input_type: InputType) -> int:
    """Return the number of keypoints of each object in a message, 0 if there is no object.

    Where the detector leaves keypoints out, this is the least possible number.

    Raises:
        MessageError: an array without dimensions that may hold pairs or triples.
    """
    mapping = _mapping(input_type)
    if mapping:
        return mapping.keypoint_count(message)
    if input_type == POINT_CLOUD:
        return int(message.width) if int(message.height) else 0
    if input_type == POLYGON:
        return len(message.polygon.points)
    shape = [int(dimension.size) for dimension in message.layout.dim]
    if len(shape) > 1:
        return shape[-2] if math.prod(shape) else 0
    numbers = max(len(message.data) - int(message.layout.data_offset), 0)
    counts = [numbers // size for size in (2, 3) if numbers % size == 0]
    if not numbers or len(counts) == 1:
        return counts[0]
    raise MessageError(
        f"data has {numbers} numbers and no dimensions; give it them (layout.dim), keypoints x 2 "
        "or 3, so that (x, y) can be told from (x, y, confidence)"
    )


def may_omit_keypoints(input_type: InputType) -> bool:
    """Return whether messages may omit keypoints, so that none shows how many there are."""
    mapping = _mapping(input_type)
    return bool(mapping and mapping.keypoint_id and not mapping.names)


def _mapping(input_type: InputType) -> FieldMapping | None:
    """Return the field mapping of an input type, None if it has none."""
    return MAPPINGS.get(input_type) if isinstance(input_type, str) else input_type


def pack_points(points: NDArray[np.floating], confidence: NDArray[np.floating]) -> bytes:
    """Return the data of a little-endian PointCloud2 of height n, width p, and `POINT_STEP`.

    Args:
        points: (n, p, 3), or (n, p, 2) with z = 0.
        confidence: (n, p).
    """
    packed = np.zeros((*confidence.shape, 4), "<f4")
    packed[..., : points.shape[-1]] = points
    packed[..., 3] = confidence
    return packed.tobytes()


def read_points(message: Any) -> NDArray[np.float32]:
    """Return x, y, z and confidence (n, p, 4) of the lifter's PointCloud2.

    Raises:
        MessageError: the cloud has other fields or another size.
    """
    n, p = int(message.height), int(message.width)
    fields = tuple((str(field.name), int(field.offset)) for field in message.fields)
    if fields != POINT_FIELDS or int(message.point_step) != POINT_STEP:
        raise MessageError(f"fields are {fields}; a lifter's points have {POINT_FIELDS}")
    data = memoryview(message.data).cast("B")
    if len(data) != n * p * POINT_STEP:
        raise MessageError(f"data has {len(data)} bytes; {n} x {p} points need {n * p * 16}")
    order = ">f4" if message.is_bigendian else "<f4"
    return np.frombuffer(data, order).reshape(n, p, 4).astype(np.float32)


def _point_cloud(message: Any, keypoints: int) -> NDArray[np.floating]:
    """Return x, y and, if there is one, confidence (n, q, 2 or 3) of a PointCloud2."""
    return point_cloud_format(message, keypoints).values(memoryview(message.data).cast("B"))


def _multi_array(message: Any, keypoints: int) -> NDArray[np.floating]:
    """Return x, y and, if there is one, confidence (n, q, 2 or 3) of a Float32MultiArray.

    The sizes of the dimensions are the shape: q x 2, q x 3, n x q x 2 or n x q x 3. Strides are
    ignored: the data is dense. With no dimension, or a single one, the data is one object: 2q
    numbers are q x 2, 3q numbers are q x 3.
    """
    data = np.asarray(message.data, np.float32)[int(message.layout.data_offset) :]
    shape = [int(dimension.size) for dimension in message.layout.dim]
    if len(shape) > 3:
        raise MessageError(f"layout has {len(shape)} dimensions; expected at most 3")
    if shape and math.prod(shape) != len(data):
        sizes = " x ".join(map(str, shape))
        raise MessageError(f"layout says {sizes} numbers; data has {len(data)} after its offset")
    if not len(data):
        return np.empty((0, keypoints, 2))  # nobody is there
    if len(shape) < 2:
        if len(data) not in (2 * keypoints, 3 * keypoints):
            raise MessageError(
                f"data has {len(data)} numbers and no dimensions (layout.dim); {keypoints} "
                f"keypoints need {2 * keypoints} (x, y) or {3 * keypoints} (x, y, confidence)"
                + _remedy(len(data), keypoints)
            )
        shape = [keypoints, len(data) // keypoints]
    *objects, count, size = shape
    if size not in (2, 3):
        turned = f": the dimensions are {count} x {size}, send them as {size} x {count}"
        raise MessageError(
            f"last dimension is {size}; expected 2 (x, y) or 3 (x, y, confidence)"
            + turned * (size == keypoints and count in (2, 3))
        )
    check_keypoints(count, keypoints, "next to last dimension")
    return data.reshape(*(objects or [1]), count, size)


def _remedy(numbers: int, keypoints: int) -> str:
    """Return what to do about another count of numbers than the layout has, for error texts."""
    if numbers and (numbers % (2 * keypoints) == 0 or numbers % (3 * keypoints) == 0):
        return (
            ": give the data of several objects dimensions (layout.dim), objects x keypoints x 2 "
            "or 3"
        )
    return f": {NAME_THE_LAYOUT}"


def _polygon(message: Any, keypoints: int) -> NDArray[np.floating]:
    """Return x, y and confidence (the field z), (1, q, 2 or 3), of a PolygonStamped.

    If z is 0 for all points, the detector gives no confidence, and all points have confidence 1.
    """
    points = message.polygon.points
    if not len(points):
        return np.empty((0, keypoints, 2))  # nobody is there
    check_keypoints(len(points), keypoints, "number of points")
    values = np.array([(p.x, p.y, p.z) for p in points], np.float64).reshape(1, keypoints, 3)
    return values if values[..., 2].any() else values[..., :2]


_READERS: dict[str, Callable[[Any, int], NDArray[np.floating]]] = {
    POINT_CLOUD: _point_cloud,
    MULTI_ARRAY: _multi_array,
    POLYGON: _polygon,
}

_IMPLIED = {"yolo_msgs/DetectionArray": "coco17", "hri_msgs/Skeleton2D": "rep155"}

INPUT_TYPES = (*_READERS, *MAPPINGS)
"""Message types that are read without a mapping file."""
