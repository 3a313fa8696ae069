# SPDX-License-Identifier: Apache-2.0
"""Messages that are serialised once: later ones differ in stamps and numbers, or short texts.

A message of 100 transforms takes milliseconds to build of Python objects, and microseconds so.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Quaternion, Transform, Vector3
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from std_msgs import msg as std_msgs

from deep_nrsfm_ros.messages.serialised import Header

STAMP = Time(sec=0x2B5A17C3, nanosec=0x31D94E6B)
"""Stamp of every header in a message that a template is made of."""
LIFETIME = Duration(sec=0x2C19D54F, nanosec=0x2E7A60B5)
"""Every lifetime in a message that a template is made of."""
TRANSFORM_NUMBERS = 7
"""Numbers of a transform: x y z, and x y z w of the quaternion."""
_MARK = 8.125e200  # the numbers of a template are this times 1, 2, 3, ...
_ENCAPSULATION = 4  # bytes before the data of a serialised message


def mark(index: int) -> float:
    """Return the number that stands for number `index` of a template, from 0 on."""
    return _MARK * (index + 1)


def text_mark(index: int, length: int) -> str:
    """Return the text of a length that stands for text `index` of a template, from 0 on."""
    return f"\x01{index:x}"[:length].ljust(length, "\x02")


def template_header(frame_id: str) -> std_msgs.Header:
    """Return the header of a message that a template is made of."""
    return std_msgs.Header(stamp=STAMP, frame_id=frame_id)


def template_transform(index: int) -> Transform:
    """Return transform `index` of a message that a template is made of."""
    x, y, z, *q = (mark(TRANSFORM_NUMBERS * index + k) for k in range(TRANSFORM_NUMBERS))
    rotation = Quaternion(x=q[0], y=q[1], z=q[2], w=q[3])
    return Transform(translation=Vector3(x=x, y=y, z=z), rotation=rotation)


class SerialisedTemplate:
    """A serialised message whose stamps, lifetimes and float64 numbers are overwritten."""

    def __init__(
        self, message: Any, count: int, serialise: Callable[[Any], bytes] = serialize_message
    ) -> None:
        """Serialise a message and find its numbers.

        Args:
            message: has `STAMP` in its headers, and `mark(0)` to `mark(count - 1)` for numbers.
            count: of numbers.
            serialise: returns the bytes of a message.

        Raises:
            ValueError: a number is missing, or is there twice.
        """
        raw = bytearray(serialise(message))
        length = len(raw)
        raw += bytes(-(length - _ENCAPSULATION) % 8)
        self._raw, self._sent = raw, memoryview(raw)[:length]
        doubles = np.frombuffer(raw, "<f8", offset=_ENCAPSULATION)
        marks = np.array([mark(i) for i in range(count)])
        # Padding holds what was in memory before: with it a slot may look like a number near them.
        at = np.flatnonzero(np.isin(doubles, marks))
        order = doubles[at].argsort()
        if not np.array_equal(doubles[at][order], marks):
            raise ValueError(f"message has {len(at)} marked numbers; expected {count}")
        self._doubles, self._at = doubles, _as_slice(at[order])
        self._words = np.frombuffer(raw, "<u4", offset=_ENCAPSULATION)
        self._stamps, self._lifetimes = self._places(STAMP), self._places(LIFETIME)

    def _places(self, time: Time | Duration) -> tuple[slice | NDArray[np.intp], ...]:
        """Return where in the words of the message seconds and nanoseconds of a time are."""
        words = self._words
        pattern = struct.unpack("<II", struct.pack("<iI", time.sec, time.nanosec))
        at = np.flatnonzero((words[:-1] == pattern[0]) & (words[1:] == pattern[1]))
        return _as_slice(at), _as_slice(at + 1)

    def __call__(self, header: Header, numbers: NDArray[Any], lifetime: float = 0.0) -> bytes:
        """Return the serialised message with a stamp and numbers.

        Args:
            header: gives the stamp.
            numbers: as many as the template has, in the order of their marks.
            lifetime: in seconds, where the message has one.
        """
        self._doubles[self._at] = numbers.reshape(-1)
        words, (seconds, rest) = self._words, self._stamps
        words[seconds], words[rest] = header.sec & 0xFFFFFFFF, header.nanosec
        seconds, rest = self._lifetimes
        words[seconds], words[rest] = int(lifetime), int(lifetime % 1 * 1e9)
        return bytes(self._sent)


def _as_slice(indices: NDArray[np.intp]) -> slice | NDArray[np.intp]:
    """Return indices as a slice if they follow each other: NumPy writes to one much faster."""
    count = len(indices)
    if not count:
        return slice(0)
    start = int(indices[0])
    return slice(start, start + count) if (np.diff(indices) == 1).all() else indices


class TextTemplate:
    """A serialised message that begins with a header, whose texts of equal lengths are overwritten.

    The length of a text moves what follows it, so there is one template for each set of lengths.
    """

    def __init__(self, message: Any, lengths: Sequence[int]) -> None:
        """Serialise a message and find its texts.

        Args:
            message: has `text_mark(i, lengths[i])` for each of its texts.
            lengths: of the texts, in bytes.

        Raises:
            ValueError: a text is missing, or is there twice.
        """
        self._raw = bytearray(serialize_message(message))
        self._ends: list[tuple[int, int]] = []
        for i, length in enumerate(lengths):
            text = text_mark(i, length).encode() + b"\0"
            at = self._raw.find(text)
            if at < 0 or self._raw.find(text, at + 1) >= 0:
                raise ValueError(f"text {i} of a template is missing, or is there twice")
            self._ends.append((at, at + length))

    def __call__(self, header: Header, texts: Sequence[str]) -> bytes:
        """Return the serialised message with a stamp and texts of the template's lengths."""
        header.write_stamp(self._raw)
        for (start, end), text in zip(self._ends, texts, strict=True):
            self._raw[start:end] = text.encode()
        return bytes(self._raw)
