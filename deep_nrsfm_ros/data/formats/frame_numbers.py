# SPDX-License-Identifier: Apache-2.0
"""Numbers of frames in the names of files and images."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.detections import stamps_at

_MOST_DIGITS = 19  # of a number of 64 bits
_LARGEST = 2**63 - 1
_SECONDS = re.compile(r"(?<!\d)([12]\d{9})(?:\.(\d{1,9})|_(\d{9}))(?!\d)")
MOST = 1_000_000_000
"""A number from here on is a time or an identifier, not that of a frame: a year at 30 Hz."""


def natural(name: Any) -> list[tuple[int, int, str]]:
    """Return a key that sorts numbers in names by value: frame_2 before frame_10."""
    text = name.name if isinstance(name, Path) else str(name)
    parts = re.split(r"(\d+)", text)
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts if p]


def numbers_in(names: Sequence[str]) -> NDArray[np.int64] | None:
    """Return the number (f,) of each frame in its name; None if the names do not say it.

    That is the only number that differs between names; all else in the names must be the
    same: 25 of `clip_000000000025_keypoints.json`, 7 of `7.jpg`. A time of seconds and nanoseconds,
    1714557600.100000000 or 1714557600_100000000, is one number, of nanoseconds.
    """
    if names and _SECONDS.search(names[0]):
        names = [_SECONDS.sub(_as_nanoseconds, name) for name in names]
    first = re.split(r"(\d+)", names[0]) if names else []
    numbers = np.empty((len(names), len(first) // 2), np.int64)
    for row, name in enumerate(names):
        parts = re.split(r"(\d+)", name)
        if len(parts) != len(first) or parts[::2] != first[::2]:
            return None
        if any(len(part) > _MOST_DIGITS for part in parts[1::2]):
            return None
        values = [int(part) for part in parts[1::2]]
        if max(values, default=0) > _LARGEST:
            return None
        numbers[row] = values
    if len(names) == 1 and numbers.size:
        return numbers[:, -1]
    differing = np.flatnonzero((numbers != numbers[:1]).any(0))
    if len(differing) != 1 or len(np.unique(numbers[:, differing[0]])) != len(names):
        return None
    return numbers[:, differing[0]]


def _as_nanoseconds(time: re.Match[str]) -> str:
    """Return the digits of a time in seconds and a fraction of them, or nanoseconds."""
    return time[1] + (time[2] or time[3]).ljust(9, "0")


def series_of(names: Sequence[str]) -> list[str]:
    """Return the patterns of names that are numbered each for itself: logi_*.json, osmo_*.json.

    Returns:
        [] unless there are several patterns, each of several names.
    """
    patterns = Counter(re.sub(r"\d+(?=\D*$)", "*", name) for name in names if name)
    several = len(patterns) > 1 and min(patterns.values()) > 1 and all("*" in p for p in patterns)
    return sorted(patterns) if several and sum(patterns.values()) == len(names) else []


def stamps_of(numbers: NDArray[np.int64] | None, frames: int, rate: float) -> NDArray[np.int64]:
    """Return the stamps (f,) in ns of frames: number / rate, or index / rate without numbers."""
    if numbers is None or not len(numbers) or numbers.max() >= MOST or numbers.min() < 0:
        return stamps_at(rate, frames)
    return np.round(numbers * (1e9 / rate)).astype(np.int64)
