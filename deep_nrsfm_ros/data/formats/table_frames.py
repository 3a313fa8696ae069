# SPDX-License-Identifier: Apache-2.0
"""Frames and times of the rows of a table."""

from __future__ import annotations

from array import array
from collections.abc import Sequence

from deep_nrsfm_ros.data.formats.builder import UNITS, DetectionsBuilder
from deep_nrsfm_ros.data.formats.cells import is_missing, stamp_of_text, whole_or_fraction
from deep_nrsfm_ros.data.read_options import DEFAULT_RATE
from deep_nrsfm_ros.lifting.sanity import Finding

_SHOWN = 4  # videos that a finding names
_MOST = 1000  # videos that are told apart


class RowFrames:
    """Gives rows their frames: by number or name, else by time, else by their place."""

    def __init__(self, builder: DetectionsBuilder, time: str = "", unit: str = "") -> None:
        """Start without frames.

        Args:
            builder: gets the frames.
            time: name of the column of the time; "" = there is none.
            unit: of the time, a key of `UNITS`; "" = not known.
        """
        self._builder, self._time, self._unit = builder, time, unit
        self._has_frames = self._has_fractions = False
        self._numbers = array("d")
        self._is_timed = bytearray()
        self._wrong = ""
        self._videos: dict[str, None] = {}

    def of(self, line: int, number: int, frame: str | float | None, times: Sequence[str]) -> int:
        """Return the index of the frame of a row; -1 if the row says none, but others do.

        Args:
            line: of the row in the file.
            number: of the row.
            frame: number or name of the frame; None = the table says none.
            times: cells of its time: one, or seconds and nanoseconds; () = none.
        """
        stamp, time = self._time_of(times, line)
        key: int | float | str | None = None
        name = ""
        if isinstance(frame, str):
            text = "" if is_missing(frame) else frame.strip().replace("\\", "/")
            key = whole_or_fraction(text)
            if key is None and text and not times and (own := stamp_of_text(text)) is not None:
                stamp, key = own, float(own)
            elif key is None and text:
                key, name = text, text.rsplit("/", 1)[1] if "/" in text else ""
                if name:
                    self.video(text.rsplit("/", 1)[0])
        elif frame is not None and frame == frame:
            key = int(frame) if frame == int(frame) else float(frame)
        if key is not None:
            self._has_frames = True
        elif self._has_frames and frame is not None:
            self._builder.leave_out("are rows without a frame", f"line {line}")
            return -1
        elif stamp is not None or time is not None:
            key = float(time if stamp is None else stamp)  # type: ignore[arg-type]
        elif times and not is_missing(times[0]):
            key = " ".join(times)
        index = self._builder.frame(number if key is None else key, name, stamp=stamp)
        self._remember(index, key, stamp is not None or time is not None)
        if time is not None:
            self._builder.time(index, time, self._unit)
        return index

    def video(self, name: str) -> None:
        """Remember that a row is of a video or camera, or of a folder of images."""
        if name and len(self._videos) < _MOST:
            self._videos[name] = None

    def finish(self) -> None:
        """Set the times that frames with fractions say, and say what looks wrong."""
        if len(self._videos) > 1:
            names = ", ".join(name.rsplit("/", 1)[-1] for name in list(self._videos)[:_SHOWN])
            more = ", ..." * (len(self._videos) > _SHOWN)
            self._builder.find(
                Finding(
                    "videos",
                    f"its frames are of {len(self._videos)} videos or cameras ({names}{more}), and "
                    "count as one recording: write a file for each",
                )
            )
        untimed = self._is_timed.count(0)
        if self._time and untimed:
            self._builder.find(
                Finding(
                    "times",
                    f"{untimed} of {len(self._is_timed)} frames have no time in column "
                    f"{self._time!r}{self._wrong}, so that no time is used, and frames follow each "
                    f"other at {DEFAULT_RATE:g} a second: write seconds, or 2024-05-01T10:00:00.3",
                )
            )
        if self._has_fractions and not self._time:
            self._builder.notes.append(
                "its numbers of frames have fractions: they are taken for times"
            )
            for index, value in enumerate(self._numbers):
                self._builder.time(index, value)

    def _remember(self, index: int, key: int | float | str | None, is_timed: bool) -> None:
        """Remember number and time of a frame."""
        while len(self._is_timed) <= index:
            self._is_timed.append(0)
            self._numbers.append(0.0)
        self._is_timed[index] |= is_timed
        if isinstance(key, (int, float)):
            self._numbers[index] = key
            self._has_fractions |= isinstance(key, float) and not is_timed

    def _time_of(self, cells: Sequence[str], line: int) -> tuple[int | None, float | None]:
        """Return the time in ns, or the number that cells say; None for what they do not say."""
        if not cells or is_missing(cells[0]):
            return None, None
        value = whole_or_fraction(cells[0])
        if value is None:
            stamp = stamp_of_text(cells[0])
            if stamp is None and not self._wrong:
                self._wrong = f" ({cells[0].strip()!r} in line {line} is none)"
            return stamp, None
        if len(cells) == 2:
            nanoseconds = whole_or_fraction(cells[1])
            if isinstance(nanoseconds, int):
                is_part = isinstance(value, int) and 0 <= nanoseconds < UNITS["seconds"]
                whole = int(value) * UNITS["seconds"] if is_part else 0
                return whole + nanoseconds, None
        return None, float(value)
