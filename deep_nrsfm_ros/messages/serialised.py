"""Serialised keypoint messages (CDR) to observations: the short way, where there is one.

Nearly all PointCloud2 of a topic differ in stamp and data alone. The first one is decoded and
checked as any message is; those that equal it in all else need neither: their keypoints are at the
same bytes. Nothing of ROS is imported: whoever reads says how bytes are decoded.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from deep_nrsfm_ros import kernel
from deep_nrsfm_ros.lifting.observation import (
    MAX_COORDINATE,
    MIN_POSITIVE,
    Observation,
    to_observation,
)
from deep_nrsfm_ros.messages.decoding import POINT_CLOUD, InputType, read_observation
from deep_nrsfm_ros.messages.field_mapping import Size
from deep_nrsfm_ros.messages.point_cloud import PointCloudFormat, point_cloud_format

_LITTLE_ENDIAN = b"\x00\x01"  # how plain CDR of that order begins
_STAMP = struct.Struct("<iI")
_STAMP_AT = 4
_LENGTH = struct.Struct("<I")
_MOST_MAKES = 64  # that are remembered: a crowd has one for each number of people
_LONGEST = 4096  # bytes before the data; a make with more is not worth remembering


class Header(NamedTuple):
    """When and by which camera a message was taken: std_msgs/Header."""

    sec: int = 0
    nanosec: int = 0
    frame_id: str = ""

    @property
    def stamp(self) -> int:
        """Return the stamp in ns."""
        return self.sec * 1_000_000_000 + self.nanosec

    def write_stamp(self, raw: bytearray) -> None:
        """Write the stamp into a serialised message that begins with a header."""
        _STAMP.pack_into(raw, _STAMP_AT, self.sec, self.nanosec)


class SerialisedFormat(NamedTuple):
    """What serialised PointCloud2 of one make have in common: all but stamp, data and padding.

    length: of the message in bytes. start, end: of its data. mask: whose bits are set where a byte
    before the data counts. head: those bytes, by the mask, as one number. is_dense: the byte after
    the data. frame_id: as the decoder reads it.
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
        """Tell whether a message is of this make."""
        return (
            len(raw) == self.length
            and _number(raw[: self.start]) & self.mask == self.head
            and raw[self.end] == self.is_dense
        )

    def header(self, raw: bytes) -> Header:
        """Return the header of a message of this make."""
        sec, nanosec = _STAMP.unpack_from(raw, _STAMP_AT)
        return Header(sec, nanosec, self.frame_id)

    def observation(self, raws: Sequence[bytes], min_confidence: float) -> Observation:
        """Return the objects of messages of this make, one after the other."""
        data = b"".join(raws)
        if kernel.AVAILABLE and self.cloud.is_float32:
            return self._compiled(data, len(raws), min_confidence)
        values = self.cloud.values(data, self.start, len(raws), self.length)
        return to_observation(values, min_confidence)

    def _compiled(self, data: bytes, messages: int, min_confidence: float) -> Observation:
        # Fifteen calls of NumPy cost three times as much, and more yet after a pause.
        cloud, shape = self.cloud, (messages * self.cloud.height, self.cloud.width)
        points, confidence = np.empty((*shape, 2), np.float32), np.empty(shape, np.float32)
        x, y, *sure = (self.start + offset for offset in cloud.offsets)
        kernel._kernel.observe(
            data,
            (messages, self.length),
            (cloud.height, cloud.width),
            (cloud.row_step, cloud.point_step),
            (x, y, *(sure or (-1,))),
            MAX_COORDINATE,
            max(np.float32(min_confidence), MIN_POSITIVE),
            points,
            confidence,
        )
        return Observation(points, confidence)


class MessageReader:
    """Reads the serialised messages of one topic, and remembers the makes that it has met.

    What it returns and raises is what decoding and `read_observation` would, to the last bit.
    """

    def __init__(self, input_type: InputType, decode: Callable[[bytes], Any]) -> None:
        """Read messages of `input_type`; `decode` makes them of bytes, or raises."""
        self.input_type, self._decode = input_type, decode
        self._makes: list[SerialisedFormat] = []  # the last that came is the first

    def __call__(
        self, raw: bytes, keypoints: int, min_confidence: float = 0.0, size: Size | None = None
    ) -> tuple[Header | None, Observation]:
        """Return the header of a message, None if its type has none, and what it shows.

        The other arguments, and what is raised, are those of `read_observation`; and whatever
        `decode` raises.
        """
        make = self.find_format(raw, keypoints)
        if make:
            return make.header(raw), make.observation((raw,), min_confidence)
        message = self._decode(raw)
        seen = read_observation(message, self.input_type, keypoints, min_confidence, size)
        header = read_header(message)
        if self.input_type == POINT_CLOUD and header:
            self._remember(raw, message, header, point_cloud_format(message, keypoints))
        return header, seen

    def find_format(self, raw: bytes, keypoints: int) -> SerialisedFormat | None:
        """Return the make of a message, None unless it was met and has so many keypoints."""
        for i, make in enumerate(self._makes):
            if make.matches(raw):
                if i:
                    self._makes.insert(0, self._makes.pop(i))
                return make if make.cloud.width == keypoints else None
        return None

    def _remember(self, raw: bytes, message: Any, header: Header, cloud: PointCloudFormat) -> None:
        """Remember the make of a message that was read, unless its bytes are not plain."""
        mask, data = _mask(raw), memoryview(message.data).cast("B")
        if mask is None:
            return
        start = len(mask)
        end, bits = start + len(data), _number(mask)
        if end < len(raw) and raw[start:end] == data:
            head = _number(raw[:start]) & bits
            frame_id = header.frame_id
            make = SerialisedFormat(len(raw), start, end, bits, head, raw[end], frame_id, cloud)
            self._makes.insert(0, make)
            del self._makes[_MOST_MAKES:]


def read_header(message: Any) -> Header | None:
    """Return the header of a decoded message, None if it has none."""
    try:
        header = message.header
        return Header(int(header.stamp.sec), int(header.stamp.nanosec), str(header.frame_id))
    except (AttributeError, TypeError, ValueError):  # a message may call something else so
        return None


def _mask(raw: bytes) -> bytes | None:
    """Return, for each byte before the data of a PointCloud2, 255, or 0 for stamp and padding.

    None if the message is not in little-endian plain CDR, or has an uncommonly long head. What
    fills the gaps between numbers is left to chance by those who write them.
    """
    mask = bytearray(b"\xff" * 4 + bytes(8))  # encapsulation, stamp

    def number() -> int:
        mask.extend(bytes(-len(mask) % 4))  # aligned, to the encapsulation's end too
        (value,) = _LENGTH.unpack_from(raw, len(mask))
        mask.extend(b"\xff" * 4)
        return int(value)

    def count(size: int) -> None:
        if len(mask) + size > _LONGEST:
            raise ValueError(f"more than {_LONGEST} bytes before the data")
        mask.extend(b"\xff" * size)

    try:
        count(number())  # frame_id
        number(), number()  # height, width
        for _ in range(number()):
            count(number())  # name
            number()  # offset
            count(1)  # datatype
            number()  # count
        count(1)  # is_bigendian
        number(), number(), number()  # point_step, row_step, length of the data
    except (struct.error, ValueError):
        return None
    return bytes(mask) if raw.startswith(_LITTLE_ENDIAN) else None


def _number(raw: bytes) -> int:
    """Return bytes as one number, so that all are compared at once."""
    return int.from_bytes(raw, "little")
