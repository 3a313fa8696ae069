# SPDX-License-Identifier: Apache-2.0
"""What the fields of JSON mean by the words in their names, whatever their spelling."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any, Literal, NamedTuple

from deep_nrsfm_ros.data.formats.builder import TIMES, as_identity

Role = Literal["frame", "time", "identity", "confidence", "keypoints", "hands", "objects", ""]

_FRAMES = ("image_id", "frame_id", "frame", "frame_number", "frame_index", "image", "file_name")
"""Names of the frame, the surest first."""
IDENTITIES = ("person_id", "track_id", "idx", "instance_id")
"""Names that mean an identity in each file."""
_NUMBER = "(?:ids?|idx|index|i|no|nr|num|number|uid)"
_UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "seconds"),
    **dict.fromkeys(("ms", "msec", "millis", "millisecond", "milliseconds"), "milliseconds"),
    **dict.fromkeys(("us", "usec", "micros", "microsecond", "microseconds"), "microseconds"),
    **dict.fromkeys(("ns", "nsec", "nanosec", "nanos", "nanosecond", "nanoseconds"), "nanoseconds"),
}
_TIME = re.compile(
    "(?:frame|video|capture|media|image|rec|recording|unix|epoch|ros|utc)?"
    f"(?:timestamp|datetime|time|stamp|pts|ts|t)(?:in)?({'|'.join(_UNITS)})?"
)
_PATTERNS: dict[Role, re.Pattern[str]] = {
    "frame": re.compile(
        "(?:video|source|src|current|cur|input)?(?:frame|image|img)"
        f"(?:{_NUMBER}|names?|paths?|files?|filenames?|filepaths?)?|fnum|file(?:name|path)?"
    ),
    "identity": re.compile(
        "(?:person|track|tracking|tracker|tracklet|body|obj|object|instance|inst|player|subject"
        f"|animal|individual|skeleton|pose|user|target|human|actor){_NUMBER}|pid|tid|uid|ids?"
        "|identity|track|individual|person|player|subject|animal"
    ),
    "keypoints": re.compile(
        "(?:pose|body|person|pred|predicted|image|2d)*(?:keypoints?|kpts?|kps|joints?|landmarks?"
        "|bodyparts|xy)(?:2d|xy|px|list)?|pose"
    ),
    "hands": re.compile(
        "(?:multi)?(?:left|right)?hands?(?:left|right)?(?:landmarks?|keypoints?|kpts?)(?:2d)?"
    ),
    "objects": re.compile(
        "people|persons|bodies|humans|instances|pred(?:iction|icted)?s?(?:instances)?|poses"
        "|(?:body|person|people|pose|object)(?:list|array)|objects|skeletons?|detections|tracks"
        "|players|animals|individuals|subjects|results|annotations|frames|data"
    ),
}
_CONFIDENCE = re.compile(
    "(?:scores?|confs?|confidences?|probs?|probabilit(?:y|ies)|vis|visib(?:les?|ility|ilities)"
    "|likelihoods?|certaint(?:y|ies)|presences?)$"
)
_USUAL = re.compile(
    "box|area|crowd|segment|mask|licen[sc]e|skeleton|categor|class|label|version|face|foot|feet"
    "|world|3d|heat|limb|orientation|rotation|handedness|hand|gender|width|height|url|date|caption"
    "|ignore|numkeypoints|detectionid|inference|latency|scale|cent(?:er|re)|info|type|visuali"
    "|partcandidates|keypointsname|keypointnames|^name$|^x$|^y$|^w$|^h$"
)
_VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".mpg", ".mpeg", ".m4v", ".wmv", ".bag")
_LONGEST = 1000  # characters of a name of a frame; a longer text is the image itself
_CLOCK = re.compile(r"(?:(\d+):)?(\d+):(\d+(?:[.,]\d+)?)")


class Time(NamedTuple):
    """A time as a file gives it.

    Attributes:
        value: the time.
        unit: a key of `builder.UNITS`; "" if the name does not say it.
    """

    value: float
    unit: str


@lru_cache(maxsize=4096)
def letters(name: str) -> str:
    """Return a name without spelling: `frameIdx`, `frame_idx` and `Frame idx` are one."""
    return "".join(character for character in name.lower() if character.isalnum())


@lru_cache(maxsize=4096)
def role(name: str) -> Role:
    """Return what a field of this name holds; "" if the name does not say it."""
    plain = letters(name)
    if name in IDENTITIES:
        return "identity"
    if time_unit(name) is not None:
        return "time"
    for meant, pattern in _PATTERNS.items():
        if pattern.fullmatch(plain):
            return meant
    return "confidence" if _CONFIDENCE.search(plain) else ""


@lru_cache(maxsize=4096)
def is_usual(name: str) -> bool:
    """Return whether a field of this name is usual beside keypoints, and says nothing of them."""
    return _USUAL.search(letters(name)) is not None


@lru_cache(maxsize=4096)
def time_unit(name: str) -> str | None:
    """Return the unit of a field that holds a time, "" if it does not say it; None for another."""
    if name in TIMES:
        return TIMES[name]
    match = _TIME.fullmatch(letters(name))
    if not match:
        return None
    is_plural = match[1] == "s" and not name.lower().endswith(("_s", "(s)", "[s]", " s"))
    return "" if is_plural else _UNITS.get(match[1], "")


@lru_cache(maxsize=4096)
def _frame_rank(name: str) -> int:
    """Return the place of a name of the frame among several: numbers come before files."""
    if name in _FRAMES:
        return _FRAMES.index(name)
    return len(_FRAMES) + any(word in letters(name) for word in ("name", "path", "file"))


def frame_field(value: Mapping[str, Any]) -> str:
    """Return the name of the field that names the frame of an object or frame; "" for none."""
    found = [name for name in value if role(name) == "frame" and _names_frame(value, name)]
    return min(found, key=_frame_rank) if len(found) > 1 else "".join(found)


def frame_key(value: Mapping[str, Any], field: str) -> int | str | None:
    """Return what the field from `frame_field` calls a frame; None if it calls it nothing."""
    key = value[field]
    if isinstance(key, list) and len(key) == 1 and field.endswith("s"):  # image_paths: ["1.jpg"]
        key = key[0]
    if isinstance(key, float) and key.is_integer():
        key = int(key)
    return key if isinstance(key, (int, str)) and not isinstance(key, bool) else None


def _names_frame(value: Mapping[str, Any], field: str) -> bool:
    """Return whether a field names a frame; the name of a video does not."""
    key = frame_key(value, field)
    if isinstance(key, str):
        return 0 < len(key) <= _LONGEST and not key.lower().endswith(_VIDEOS)
    return key is not None


def identity_field(value: Mapping[str, Any]) -> str:
    """Return the name of the field with the identity of an object; "" for none.

    `id` of an annotation of COCO is its number, and no identity.
    """
    for name in IDENTITIES:
        if name in value and as_identity(value[name]) is not None:
            return name
    numbers = ("id", "ids") if is_annotation(value) else ()
    for name, given in value.items():
        is_identity = role(name) == "identity" and as_identity(given) is not None
        if is_identity and name.lower() not in numbers:
            return name
    return ""


def is_annotation(value: Mapping[str, Any]) -> bool:
    """Return whether an object is an annotation or a result of COCO, whose `id` is its number."""
    return "image_id" in value or "category_id" in value


def time_field(value: Mapping[str, Any]) -> str:
    """Return the name of the field with the time of an object or frame; "" for none."""
    for name, given in value.items():
        if given is not None and not isinstance(given, (list, bool)) and role(name) == "time":
            return name
    stamp = value.get("header")
    if isinstance(stamp, dict) and time_field(stamp):
        return "header"
    return "sec" if _seconds_of(value) is not None else ""


def time_of(value: Mapping[str, Any], field: str) -> Time | None:
    """Return the time in a field from `time_field`; None if it cannot be read.

    It is a number, a text of a number, a date (ISO 8601), h:m:s, or seconds and nanoseconds.
    """
    if field == "sec":
        nanoseconds = _seconds_of(value)
        return None if nanoseconds is None else Time(nanoseconds, "nanoseconds")
    given = value[field]
    if isinstance(given, dict):
        inner = time_field(given)
        return time_of(given, inner) if inner else None
    if isinstance(given, str):
        return _time_of_text(given.strip(), time_unit(field) or "")
    if isinstance(given, (int, float)) and math.isfinite(given) and abs(given) < 2**63:
        return Time(given, time_unit(field) or "")
    return None


def _time_of_text(text: str, unit: str) -> Time | None:
    """Return the time that a text says; None if it says none."""
    with suppress(ValueError):
        number = float(text)
        return Time(number, unit) if math.isfinite(number) else None
    if match := _CLOCK.fullmatch(text):
        hours, minutes, seconds = match[1] or "0", match[2], match[3].replace(",", ".")
        return Time(int(hours) * 3600 + int(minutes) * 60 + float(seconds), "seconds")
    with suppress(ValueError, OverflowError):
        date = datetime.fromisoformat(text)
        date = date if date.tzinfo else date.replace(tzinfo=UTC)
        return Time(date.timestamp(), "seconds")
    return None


def _seconds_of(value: Mapping[str, Any]) -> int | None:
    """Return the ns of {sec, nanosec} of ROS, {secs, nsecs} of ROS 1; None if it is none."""
    for name, nano in (("sec", "nanosec"), ("secs", "nsecs"), ("sec", "nsec")):
        if name in value and nano in value:
            seconds, rest = value[name], value[nano]
            if isinstance(seconds, int) and isinstance(rest, int) and abs(seconds) < 2**33:
                return seconds * 10**9 + rest
    return None
