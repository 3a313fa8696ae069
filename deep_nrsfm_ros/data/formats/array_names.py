# SPDX-License-Identifier: Apache-2.0
"""What the arrays of an .npz beside `points` hold, by their shapes and the words in their names."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from math import prod
from typing import Any, NamedTuple

import numpy as np

from deep_nrsfm_ros.data.formats.builder import TIMES
from deep_nrsfm_ros.data.formats.unused import find_unused, meaning, unused_sentence, words_of
from deep_nrsfm_ros.lifting.sanity import Finding

NATIVE = (
    *("points", "confidence", "frame", "stamps", "identities", "scores"),
    *("names", "frame_numbers", "frame_names"),
)
"""Arrays under the names that docs/tutorials/files.md has for them."""
_TAKEN_FOR = {
    "confidence": "the confidence",
    "scores": "the scores of the objects",
    "identities": "the identities",
    "numbers": "the numbers of the frames",
    "rate": "the frames per second",
    "names": "the names of the keypoints",
}
"""What arrays of other names are read as: roles -> words."""
_RATES = {"fps", "rate", "hz", "framerate"}
_NAMES = {"names", "name", "keypoints", "bodyparts", "joints", "nodes", "landmarks", "parts"}
_UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "seconds"), "seconds"),
    **dict.fromkeys(("ms", "msec", "milliseconds"), "milliseconds"),
    **dict.fromkeys(("us", "µs", "μs", "usec", "microseconds"), "microseconds"),
    **dict.fromkeys(("ns", "nsec", "nanoseconds"), "nanoseconds"),
}
_NO_IDENTITY = {"category", "class", "label", "cat", "cls", "video", "camera", "cam"}
_NO_TIME = {"inference", "elapsed", "duration", "latency", "runtime", "processing", "exposure"}
_NO_FRAME = {"width", "height", "size", "shape", "w", "h"}
_USUAL = {
    *("bbox", "bboxes", "box", "boxes", "area", "areas", "width", "height", "image_size", "edges"),
    *("skeleton", "model", "category_id", "iscrowd", "segmentation", "intrinsics", "K"),
}
"""Arrays that many files have and no reader needs; nothing is said of them."""


class Header(NamedTuple):
    """Shape of an array, and the kind of its numbers as NumPy's `dtype.kind`."""

    shape: tuple[int, ...]
    kind: str


def read_headers(file: Any) -> dict[str, Header]:
    """Return the headers of the arrays in an open .npz, whose content is not read.

    An array without a readable header has an empty shape, and "?" as kind.
    """
    return {name: _header(file, name) for name in file.files}


def _header(file: Any, name: str) -> Header:
    npy: Any = np.lib.format  # without types
    readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    try:
        with file.zip.open(f"{name}.npy") as member:
            shape, _, dtype = readers[npy.read_magic(member)](member)
        return Header(shape, dtype.kind)
    except Exception:  # damaged bytes make zipfile and NumPy raise many types
        return Header((), "?")


def find_roles(headers: Mapping[str, Header]) -> dict[str, str]:
    """Return what is read -> the array that holds it.

    Args:
        headers: of all arrays, with `points`.

    Returns:
        Names of `NATIVE`, and "numbers" of frames, "times" and "rate". Under a name of its own an
        array has that role, but `scores` with a number for each keypoint are the confidence.
    """
    roles = {name: name for name in NATIVE if name in headers}
    points = headers["points"].shape
    if len(points) < 3:
        return roles
    lead, q = points[:-2], points[-2]
    if "confidence" not in roles and _fits(headers.get("scores"), (*lead, q)):
        roles["confidence"] = roles.pop("scores")
    for name, header in headers.items():
        role = "" if name in NATIVE else _role(name, header, lead, q)
        if role and role not in roles and not _is_known(role, roles):
            roles[role] = name
    return roles


def _fits(header: Header | None, shape: tuple[int, ...]) -> bool:
    """Return whether an array has a shape, whose first axes may be one."""
    if header is None:
        return False
    shapes = [shape, (*shape, 1)]
    if len(shape) > 1:
        shapes.append((prod(shape[:-1]), shape[-1]))
    return header.shape in shapes


def _is_known(role: str, roles: Collection[str]) -> bool:
    """Return whether other arrays say already what one of this role would say."""
    others = {"numbers": {"frame"}, "times": {"stamps"}, "rate": {"stamps"}}
    return not others.get(role, set()).isdisjoint(roles)


def _role(name: str, header: Header, lead: tuple[int, ...], q: int) -> str:
    """Return the role of an array by its name and shape, or ""."""
    shape, kind = header
    words, what = words_of(name), meaning(name)
    is_number = kind in "fiu"
    if prod(shape) == 1 and is_number and words & _RATES:
        return "rate"
    if what == "a confidence" and kind in "fiub" and _fits(header, (*lead, q)):
        return "confidence"
    if kind == "U" and shape == (q,) and words & _NAMES:
        return "names"
    is_time = meaning(re.sub("(?i)frame|image|img", "", name)) == "the time"
    is_time = is_time and not words & _NO_TIME or name.lower() in TIMES
    if is_number and len(shape) == 1 and is_time:
        return "times"
    if what == "the frame" and is_number and not words & _NO_FRAME:
        return "numbers" if shape in (lead, lead[:1], (prod(lead),)) else ""
    if shape not in (lead, (prod(lead),)):
        return ""
    if what == "a confidence" and is_number:
        return "scores"
    if what == "an identity" and kind in "fiuU" and not words & _NO_IDENTITY:
        return "identities"
    return ""


def points_under_another_name(headers: Mapping[str, Header]) -> str:
    """Return the name of the one array that may be `points`; "" if none or several may."""
    found = [
        name
        for name, (shape, kind) in headers.items()
        if kind in "fiu" and len(shape) in (3, 4) and shape[-1] in (2, 3, 4)
    ]
    return found[0] if len(found) == 1 else ""


def unit_in_name(name: str) -> str:
    """Return the unit of time that the name of an array says, a key of `UNITS`, or ""."""
    if unit := TIMES.get(name, TIMES.get(name.lower(), "")):
        return unit
    return next((unit for word, unit in _UNITS.items() if word in words_of(name)), "")


def taken_for(roles: Mapping[str, str]) -> list[str]:
    """Return a sentence on the arrays that are read under other names than their own, if any."""
    others = [
        f"`{name}` for {_TAKEN_FOR[role]}"
        for role, name in roles.items()
        if role != name and role in _TAKEN_FOR
    ]
    return [f"taken: {', '.join(others)}"] if others else []


def find_unused_arrays(
    headers: Mapping[str, Header], roles: Mapping[str, str]
) -> tuple[list[str], list[Finding]]:
    """Return the sentence that names the arrays that are not used, and what looks wrong in it.

    An array is suspicious only if it has a number or text for each object or frame, or for each
    keypoint.
    """
    used = {"points", *roles.values()}
    left = [name for name in headers if name not in used and name not in _USUAL]
    if not left:
        return [], []
    has_time = not {"stamps", "times", "rate"}.isdisjoint(roles)
    remedies = {
        "the frame": "" if {"frame", "numbers"} & set(roles) else "frame",
        "the time": "" if has_time else "stamps",
        "an identity": "" if "identities" in roles else "identities",
        "a confidence": "" if {"confidence", "scores"} & set(roles) else "confidence",
    }
    points = headers["points"].shape
    lead = points[:-2]
    shapes = {lead, lead[:1], (prod(lead),), points[:-1]} - {()}
    others = _NO_FRAME | _NO_IDENTITY | _NO_TIME
    suspects = [
        name
        for name in left
        if headers[name].shape in shapes
        and headers[name].kind != "O"
        and not words_of(name) & others
    ]
    known = {what: name for what, name in remedies.items() if name}
    # Python objects are never read, since they could run code.
    listed = [f"{name} (Python objects)" if headers[name].kind == "O" else name for name in left]
    return [unused_sentence("arrays", listed)], find_unused("arrays", suspects, known)
