# SPDX-License-Identifier: Apache-2.0
"""Messages with many numbers, serialised once: later ones differ in stamps and numbers only.

A message of 100 transforms takes milliseconds to build of Python objects, and microseconds so.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from rclpy.serialization import serialize_message

from deep_nrsfm_ros.messages.serialised import Header

STAMP = Time(sec=0x2B5A17C3, nanosec=0x31D94E6B)
"""Stamp of every header in a message that a template is made of."""
_MARK = 8.125e200  # the numbers of a template are this times 1, 2, 3, ...
_ENCAPSULATION = 4  # bytes before the data of a serialised message


def mark(index: int) -> float:
    """Return the number that stands for number `index` of a template, from 0 on."""
    return _MARK * (index + 1)


class SerialisedTemplate:
    """A serialised message whose stamps and float64 numbers are overwritten."""

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
        at = np.flatnonzero((doubles >= mark(0)) & (doubles <= mark(count - 1)) if count else [])
        order = doubles[at].argsort()
        if len(at) != count or not np.allclose(doubles[at][order], _MARK * np.arange(1, count + 1)):
            raise ValueError(f"message has {len(at)} marked numbers; expected {count}")
        self._doubles, self._at = doubles, at[order]
        words = np.frombuffer(raw, "<u4", offset=_ENCAPSULATION)
        pattern = struct.unpack("<II", struct.pack("<iI", STAMP.sec, STAMP.nanosec))
        self._words = words
        self._stamps = np.flatnonzero((words[:-1] == pattern[0]) & (words[1:] == pattern[1]))

    def __call__(self, header: Header, numbers: NDArray[Any]) -> bytes:
        """Return the serialised message with a stamp and numbers.

        Args:
            header: gives the stamp.
            numbers: as many as the template has, in the order of their marks.
        """
        self._doubles[self._at] = numbers.reshape(-1)
        self._words[self._stamps] = header.sec & 0xFFFFFFFF
        self._words[self._stamps + 1] = header.nanosec
        return bytes(self._sent)
