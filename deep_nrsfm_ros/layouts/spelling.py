# SPDX-License-Identifier: Apache-2.0
"""Names of keypoints that are equal up to their spelling: left_ear, Ear_L, EarLeft."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from functools import lru_cache

from deep_nrsfm_ros.layouts.layout import SIDE_WORDS

ALIASES = {
    "sho": "shoulder",
    "elb": "elbow",
    "wri": "wrist",
    "kne": "knee",
    "ank": "ankle",
    "bigtoe": "big_toe",
    "smalltoe": "small_toe",
    "midhip": "mid_hip",
}
"""Short names of keypoints, without their side -> the names of the presets."""


@lru_cache(4096)
def side_and_rest(name: str) -> tuple[tuple[str, ...], str]:
    """Return the sides in a name, and the rest of it: ("left",), "small_toe" of LSmallToe."""
    words = re.sub(r"([a-z0-9])([A-Z])|([A-Z])([A-Z][a-z])", r"\1\3_\2\4", name).lower()
    parts = [part for part in re.split(r"[\W_]+", words) if part]
    sides = tuple(SIDE_WORDS[part] for part in parts if part in SIDE_WORDS)
    return sides, "_".join(part for part in parts if part not in SIDE_WORDS)


def match_names(names: Sequence[str], wanted: Iterable[str]) -> dict[str, int]:
    """Return the wanted names that are among some names -> their places there.

    Equal names match first. Those that are left match where they are equal up to case and
    separators (EarL, ear_l), then up to place and form of the side (ear_l, left_ear). A spelling
    that several names have matches none of them.

    Args:
        names: of the keypoints of an input.
        wanted: names to find among them.
    """
    wanted = tuple(dict.fromkeys(wanted))
    places = {name: i for i, name in enumerate(names)}
    found = {name: places[name] for name in wanted if name in places}
    for form in (_folded, _key):
        _match(found, _forms(form, names), _forms(form, wanted), places)
    return found


def _match(
    found: dict[str, int],
    own: Mapping[str, Hashable],
    wanted: Mapping[str, Hashable],
    places: Mapping[str, int],
) -> None:
    """Add names to `found` that have one form, and are the only ones of their side that have it."""
    taken = set(found.values())
    free = [name for name in own if places[name] not in taken]
    left = [name for name in wanted if name not in found]
    if not free or not left:
        return
    times, wanted_times = Counter(own.values()), Counter(wanted.values())
    by_form = {own[name]: name for name in free if times[own[name]] == 1}
    for name in left:
        form = wanted[name]
        if wanted_times[form] == 1 and form in by_form:
            found[name] = places[by_form[form]]


def _forms(form: Callable[[str], Hashable], names: Iterable[str]) -> dict[str, Hashable]:
    """Return the form of each name that has one."""
    return {name: shape for name in names if (shape := form(name))}


def _folded(name: str) -> str:
    """Return a name without case and separators; numbers stay apart: finger_1_2 is no finger_12."""
    spaced = re.sub(r"(?<=\d)[\W_]+(?=\d)", " ", name.casefold())
    return re.sub(r"[^\w ]+|_+", "", re.sub(r"(?<!\d) +| +(?!\d)", "", spaced))


def _key(name: str) -> tuple[tuple[str, ...], str] | None:
    """Return the side and the rest of a name, in the words of the presets; None: it has no rest."""
    sides, rest = side_and_rest(name)
    return (sides, ALIASES.get(rest, rest)) if rest else None
