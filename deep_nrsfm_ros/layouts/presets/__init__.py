# SPDX-License-Identifier: Apache-2.0
"""The keypoint layouts that come with the package, each a layout file in this folder.

A file is read when its layout is first used: `preset("coco17")`, `LAYOUTS["coco17"]` and
`from deep_nrsfm_ros.layouts.presets import COCO17` give the same object.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.layout_file import read_layout

NAMES = [
    *("human17", "human25", "cmu31", "coco17", "body25", "body25b", "openpose18", "rep155"),
    *("mediapipe33", "mediapipe75"),
    *("halpe26", "halpe136", "coco_wholebody133", "mpii16", "h36m17", "crowdpose14"),
    *("openpose135", "hand21", "ap10k17", "posetrack15", "posetrack18_17"),
    *("zed18", "zed34", "zed38"),
]
_FOLDER = Path(__file__).parent

# Without values, so that `__getattr__` reads the file of a layout at its first use.
HUMAN17: KeypointLayout
HUMAN25: KeypointLayout
CMU31: KeypointLayout
COCO17: KeypointLayout
BODY25: KeypointLayout
BODY25B: KeypointLayout
OPENPOSE18: KeypointLayout
REP155: KeypointLayout
MEDIAPIPE33: KeypointLayout
MEDIAPIPE75: KeypointLayout
HALPE26: KeypointLayout
HALPE136: KeypointLayout
COCO_WHOLEBODY133: KeypointLayout
MPII16: KeypointLayout
H36M17: KeypointLayout
CROWDPOSE14: KeypointLayout
OPENPOSE135: KeypointLayout
HAND21: KeypointLayout
AP10K17: KeypointLayout
POSETRACK15: KeypointLayout
POSETRACK18_17: KeypointLayout
ZED18: KeypointLayout
ZED34: KeypointLayout
ZED38: KeypointLayout


@cache
def preset(name: str) -> KeypointLayout:
    """Return the preset called `name`; raise ValueError that lists the presets."""
    if name not in NAMES:
        raise ValueError(f"no keypoint layout {name!r}; presets: {', '.join(NAMES)}")
    return read_layout(_FOLDER / f"{name}.yaml")


class _Presets(Mapping[str, KeypointLayout]):
    """The presets by name, each read at its first use."""

    def __getitem__(self, name: str) -> KeypointLayout:
        if name not in NAMES:
            raise KeyError(name)
        return preset(name)

    def __contains__(self, name: object) -> bool:
        return name in NAMES

    def __iter__(self) -> Iterator[str]:
        return iter(NAMES)

    def __len__(self) -> int:
        return len(NAMES)


LAYOUTS: Mapping[str, KeypointLayout] = _Presets()


def __getattr__(name: str) -> KeypointLayout:
    """Return the preset of a constant: HUMAN17 is that of human17."""
    if name.lower() in NAMES and name.isupper():
        return preset(name.lower())
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


@cache
def preset_keypoints() -> frozenset[str]:
    """Return the names of the keypoints of all presets, whose files are read for it."""
    return frozenset(keypoint for layout in LAYOUTS.values() for keypoint in layout.keypoints)
