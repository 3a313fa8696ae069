# SPDX-License-Identifier: Apache-2.0
"""Read serialised keypoint messages (CDR), fast where their format has been read before.

Nearly all PointCloud2 messages of a topic differ only in stamp and data. The first one is decoded
and checked like any message. The keypoints of those that equal it elsewhere are at the same bytes,
so they need neither. ROS is not imported: the caller supplies the decoder.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros import kernel
from deep_nrsfm_ros.lifting.observation import (
    MAX_COORDINATE,
    MIN_POSITIVE,
    MessageError,
    Observation,
    to_observation,
)
from deep_nrsfm_ros.messages.decoding import (
    POINT_CLOUD,
    InputType,
    count_keypoints,
    read_confidence,
    read_observation,
)
from deep_nrsfm_ros.messages.field_mapping import Size
from deep_nrsfm_ros.messages.point_cloud import (
    PointCloudFormat,
    point_cloud_format,
    unused_confidence,
)

_LITTLE_ENDIAN = b"\x00\x01"  # the first bytes of plain little-endian CDR
_STAMP = struct.Struct("<iI")
_STAMP_OFFSET = 4
_LENGTH = struct.Struct("<I")
_MAX_FORMATS = 64  # that are kept: a crowd has one for each number of people
_MAX_HEAD = 4096  # bytes before the data of a format that is kept


class Header(NamedTuple):
    """std_msgs/Header: time and camera of a message.

    Attributes:
        sec: seconds of the stamp.
        nanosec: nanoseconds of the stamp.
        frame_id: optical frame of the camera.
    """

    sec: int = 0
    nanosec: int = 0
    frame_id: str = ""

    @property
    def stamp(self) -> int:
        """The stamp in ns."""
        return self.sec * 1_000_000_000 + self.nanosec

    def later(self, nanoseconds: int) -> Header:
        """Return the header with its stamp so much later."""
        sec, nanosec = divmod(self.stamp + nanoseconds, 1_000_000_000)
        return self._replace(sec=sec, nanosec=nanosec)

    def write_stamp(self, raw: bytearray) -> None:
        """Write the stamp into a serialised message that begins with a header."""
        _STAMP.pack_into(raw, _STAMP_OFFSET, self.sec, self.nanosec)


class SerialisedFormat(NamedTuple):
    """The bytes that serialised PointCloud2 share: all but stamp, data and padding.

    Attributes:
        length: bytes of the message.
        start: first byte of its data.
        end: byte after its data.
        mask: bits set for the bytes before the data that must be equal, as one number.
        head: those bytes, as one number.
        is_dense: the byte at `end`.
        frame_id: of the header.
        cloud: memory layout of the data.
    """

    length: int
    start: int
    end: int
    mask: int
    head: int
    is_dense: int
    frame_id: str
    cloud: PointCloudFormat

    def matches(self, raw: bytes) -> bool:
        """Return whether a serialised message has this format."""
        return (
            len(raw) == self.length
            and _to_number(raw[: self.start]) & self.mask == self.head
            and raw[self.end] == self.is_dense
        )

    def header(self, raw: bytes) -> Header:
        """Return the header of a serialised message of this format."""
        sec, nanosec = _STAMP.unpack_from(raw, _STAMP_OFFSET)
        return Header(sec, nanosec, self.frame_id)

    def read(self, raws: Sequence[bytes], min_confidence: float) -> Observation:
        """Return the objects of serialised messages of this format, one after the other."""
        data = b"".join(raws)
        if kernel.AVAILABLE and self.cloud.is_float32:
            return self._read_compiled(data, len(raws), min_confidence)
        values = self.cloud.values(data, self.start, len(raws), self.length)
        return to_observation(values, min_confidence)

    def _read_compiled(self, data: bytes, messages: int, min_confidence: float) -> Observation:
        """Return what `read` returns, in one call of the kernel: a third of NumPy's time."""
        cloud, shape = self.cloud, (messages * self.cloud.height, self.cloud.width)
        points, confidence = np.empty((*shape, 2), np.float32), np.empty(shape, np.float32)
        x, y, *confidence_offset = (self.start + offset for offset in cloud.offsets)
        kernel._kernel.decode_keypoints(
            data,
            (messages, self.length),
            (cloud.height, cloud.width),
            (cloud.row_step, cloud.point_step),
            (x, y, *(confidence_offset or (-1,))),
            MAX_COORDINATE,
            max(np.float32(min_confidence), MIN_POSITIVE),
            points,
            confidence,
        )
        return Observation(points, confidence)


class MessageReader:
    """Reads the serialised messages of one topic and keeps the formats that it has read.

    It returns and raises what decoding and `read_observation` would, to the last bit.

    Attributes:
        input_type: type of the messages.
        unused_confidence: as the function of that name says of the last message whose format was
            new; "" of any other type.
    """

    def __init__(self, input_type: InputType, decode: Callable[[bytes], Any]) -> None:
        """Start without formats.

        Args:
            input_type: type of the messages.
            decode: returns a message for its bytes, or raises.
        """
        self.input_type, self._decode = input_type, decode
        self.unused_confidence = ""
        self._formats: list[SerialisedFormat] = []  # the latest first

    def __call__(
        self, raw: bytes, keypoints: int, min_confidence: float = 0.0, size: Size | None = None
    ) -> tuple[Header | None, Observation]:
        """Return the header of a message, None if its type has none, and its objects.

        Args:
            raw: the serialised message.
            keypoints: as in `read_observation`.
            min_confidence: as in `read_observation`.
            size: as in `read_observation`.

        Raises:
            MessageError: as `read_observation`; and what `decode` raises.
        """
        known = self.find_format(raw, keypoints)
        if known:
            return known.header(raw), known.read((raw,), min_confidence)
        message = self._decode(raw)
        observation = read_observation(message, self.input_type, keypoints, min_confidence, size)
        header = read_header(message)
        if self.input_type == POINT_CLOUD:
            self.unused_confidence = unused_confidence(message)
        if self.input_type == POINT_CLOUD and header:
            self._add_format(raw, message, header, point_cloud_format(message, keypoints))
        return header, observation

    def count(self, raw: bytes) -> int:
        """Return the number of keypoints of each object in a message, 0 if there is no object.

        Raises:
            MessageError: as `count_keypoints`; and what `decode` raises.
        """
        return count_keypoints(self._decode(raw), self.input_type)

    def confidence(
        self, raw: bytes, keypoints: int, size: Size | None = None
    ) -> NDArray[np.floating[Any]]:
        """Return the confidence (n, q) of a message as the detector gives it, not limited to 1.

        Args:
            raw: the serialised message.
            keypoints: as in `read_observation`.
            size: as in `read_observation`.

        Raises:
            Exception: as `read_confidence`; and what `decode` raises.
        """
        return read_confidence(self._decode(raw), self.input_type, keypoints, size)

    def find_format(self, raw: bytes, keypoints: int) -> SerialisedFormat | None:
        """Return the kept format of a message; None: it has none or another number of keypoints."""
        for i, known in enumerate(self._formats):
            if known.matches(raw):
                if i:
                    self._formats.insert(0, self._formats.pop(i))
                return known if known.cloud.width == keypoints else None
        return None

    def _add_format(
        self, raw: bytes, message: Any, header: Header, cloud: PointCloudFormat
    ) -> None:
        """Keep the format of a message that has been read, unless its bytes are not plain CDR."""
        mask, data = _mask(raw), memoryview(message.data).cast("B")
        if mask is None:
            return
        start = len(mask)
        end, bits = start + len(data), _to_number(mask)
        if end < len(raw) and raw[start:end] == data:
            head = _to_number(raw[:start]) & bits
            frame_id = header.frame_id
            new = SerialisedFormat(len(raw), start, end, bits, head, raw[end], frame_id, cloud)
            self._formats.insert(0, new)
            del self._formats[_MAX_FORMATS:]


def read_stamp(raw: bytes) -> int:
    """Return the stamp in ns of a serialised message that begins with a std_msgs/Header.

    Raises:
        MessageError: the message is too short.
    """
    order = "<" if raw[:2] == _LITTLE_ENDIAN else ">"
    try:
        sec, nanosec = struct.unpack_from(order + "iI", raw, _STAMP_OFFSET)
    except struct.error:
        raise MessageError(f"{len(raw)} bytes, too few for a header") from None
    return int(sec) * 1_000_000_000 + int(nanosec)


def read_header(message: Any) -> Header | None:
    """Return the header of a decoded message; None: it has no std_msgs/Header."""
    try:
        header = message.header
        return Header(int(header.stamp.sec), int(header.stamp.nanosec), str(header.frame_id))
    except (AttributeError, TypeError, ValueError):  # a field `header` may be of another type
        return None


def _mask(raw: bytes) -> bytes | None:
    """Return 255 for each byte before the data of a PointCloud2, and 0 for stamp and padding.

    None if the message is not plain little-endian CDR, or has more than `_MAX_HEAD` bytes before
    the data. Writers leave the padding between numbers undefined, so it must not be compared.
    """
    mask = bytearray(b"\xff" * 4 + bytes(8))  # encapsulation, stamp

    def number() -> int:
        mask.extend(bytes(-len(mask) % 4))  # numbers are aligned to the end of the encapsulation
        (value,) = _LENGTH.unpack_from(raw, len(mask))
        mask.extend(b"\xff" * 4)
        return int(value)

    def skip(size: int) -> None:
        if len(mask) + size > _MAX_HEAD:
            raise ValueError(f"more than {_MAX_HEAD} bytes before the data")
        mask.extend(b"\xff" * size)

    try:
        skip(number())  # frame_id
        number(), number()  # height, width
        for _ in range(number()):
            skip(number())  # name
            number()  # offset
            skip(1)  # datatype
            number()  # count
        skip(1)  # is_bigendian
        number(), number(), number()  # point_step, row_step, length of the data
    except (struct.error, ValueError):
        return None
    return bytes(mask) if raw.startswith(_LITTLE_ENDIAN) else None


def _to_number(raw: bytes) -> int:
    """Return bytes as one number, so that all are compared at once."""
    return int.from_bytes(raw, "little")
