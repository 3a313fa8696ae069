# SPDX-License-Identifier: Apache-2.0
"""Names of keypoints in files, in the spelling of the layouts."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from difflib import SequenceMatcher

from deep_nrsfm_ros.layouts.layout import SIDE_WORDS, KeypointLayout
from deep_nrsfm_ros.layouts.presets import LAYOUTS, preset_keypoints
from deep_nrsfm_ros.layouts.spelling import ALIASES, match_names, side_and_rest

NAMED_BY_INPUT = "names_of_the_input"
"""Name of a layout of the names in an input, which are not those of a preset."""
_DATASETS = {
    "coco": "coco17",
    "halpe": "halpe136",
    "halpe26": "halpe26",
    "body8_halpe26": "halpe26",
    "coco_wholebody": "coco_wholebody133",
    "mpii": "mpii16",
    "h36m": "h36m17",
    "crowdpose": "crowdpose14",
    "ap10k": "ap10k17",
    "posetrack18": "posetrack18_17",
    "coco_wholebody_hand": "hand21",
}
"""Datasets of MMPose -> presets."""
_ALIKE = 0.7  # of the letters of two names: knie and knee have 0.75, hip and hand 0.3
_COUNTED = re.compile(
    r"(kp|kpt|keypoint|key_?point|point|pt|joint|landmark|lm|marker|p|k|j)[_ .-]?(\d{1,4})",
    re.IGNORECASE,
)


def layout_of_dataset(dataset: str) -> KeypointLayout | None:
    """Return the preset of a dataset of MMPose, "coco"; None if there is none."""
    name = _DATASETS.get(dataset.lower(), dataset.lower())
    return LAYOUTS.get(name)


def layout_of_names(names: Sequence[str], owners: Iterable[KeypointLayout] = ()) -> KeypointLayout:
    """Return the layout with these keypoints: a preset if one has them, else a layout of them.

    A name that an owner has in any spelling becomes the owner's. Other known keypoints of another
    spelling ("LShoulder", "shoulder_l", "left shoulder") get that of the presets; a name of no
    preset remains.

    Args:
        names: of the keypoints of an input.
        owners: layouts to which the keypoints may be mapped, such as that of the model.

    Raises:
        ValueError: a name is not unique.
    """
    own: dict[str, str] = {}
    for owner in owners:
        for name, place in match_names(names, owner.keypoints).items():
            own.setdefault(names[place], name)
    spelt = tuple(own.get(name) or preset_spelling(name) for name in names)
    for keypoints in (tuple(names), spelt):
        for preset in LAYOUTS:
            if LAYOUTS[preset].keypoints == keypoints:
                return LAYOUTS[preset]
    return KeypointLayout(NAMED_BY_INPUT, spelt if len(set(spelt)) == len(spelt) else tuple(names))


def are_numbers(names: Sequence[str]) -> bool:
    """Return whether names only count the keypoints: kp0, kp1, ... or point_1, point_2, ..."""
    found = [_COUNTED.fullmatch(name) for name in names]
    marks = {match[1].lower() for match in found if match}
    numbers = [int(match[2]) for match in found if match]
    is_series = numbers in (list(range(len(names))), list(range(1, len(names) + 1)))
    return None not in found and len(marks) == 1 and is_series


def preset_spelling(name: str) -> str:
    """Return the name of a keypoint as the presets spell it, or `name` if none of them has it."""
    known = preset_keypoints()
    if name in known:
        return name
    sides, rest = side_and_rest(name)
    bare = [rest, ALIASES.get(rest, rest)]
    if sides:
        candidates = [f"{sides[0]}_{name}" for name in bare]
    elif rest[:1] in SIDE_WORDS:  # lshoulder
        side, part = SIDE_WORDS[rest[0]], rest[1:]
        candidates = [*bare, *(f"{side}_{p}" for p in (part, ALIASES.get(part, part)))]
    else:
        candidates = bare
    return next((candidate for candidate in candidates if candidate in known), name)


def misspelt(names: Collection[str], wanted: Sequence[str]) -> dict[str, str]:
    """Return the names that are unknown and nearly a wanted one that is missing -> that one.

    A name of any preset is known: a detector may give keypoints that a model lacks.

    Args:
        names: of the keypoints of an input.
        wanted: names of the keypoints of a model.
    """
    missing = {name: side_and_rest(name) for name in wanted if name not in names}
    found: dict[str, str] = {}
    for name in names:
        if name in preset_keypoints() or name in wanted:
            continue
        sides, rest = side_and_rest(name)
        likeness = {
            other: SequenceMatcher(None, rest, other_rest).ratio()
            for other, (other_sides, other_rest) in missing.items()
            if other_sides == sides
        }
        best = max(likeness, key=likeness.__getitem__, default="")
        if best and likeness[best] >= _ALIKE:
            found[name] = best
    return found


def unknown_names(names: Collection[str], wanted: Sequence[str]) -> list[str]:
    """Return the names that are neither wanted ones nor those of a preset."""
    return [name for name in names if name not in wanted and name not in preset_keypoints()]


def are_mostly_known(names: Collection[str], wanted: Sequence[str]) -> bool:
    """Return whether at least half of some names are wanted ones, or those of a preset."""
    return 2 * len(unknown_names(names, wanted)) <= len(names)


def contradiction(layout: KeypointLayout, names: KeypointLayout) -> str:
    """Return how the names that an input gives contradict a layout; "" if they do not.

    Names of another language or numbering contradict nothing, as long as there are as many.
    """
    if layout.keypoints == names.keypoints:
        return ""
    if len(layout) != len(names):
        return f"it names {len(names)} keypoints, {layout.name} has {len(layout)}"
    found = match_names(names.keypoints, layout.keypoints)
    moved = [place for name, place in found.items() if layout.index(name) != place]
    if not moved:
        return ""
    own, other = names.keypoints[min(moved)], layout.keypoints[min(moved)]
    return f"its keypoint {min(moved)} is {own}, that of {layout.name} is {other}"
