# SPDX-License-Identifier: Apache-2.0
"""Models that come with the package and have the keypoints of an object."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap, TooFewSharedError
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN25, LAYOUTS
from deep_nrsfm_ros.layouts.spelling import match_names
from deep_nrsfm_ros.model_files.find_layout import NUMBERED, find_layout
from deep_nrsfm_ros.model_files.folders import shipped_models
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, ModelFileError, load_once

FROM_NONE = "none"
"""Stands for no model to start from: random weights."""

_MIN_SHARED = 0.7  # of the keypoints of the smaller layout; people of all presets have 0.71 or more


def knows(model: KeypointLayout, layout: KeypointLayout) -> bool:
    """Return whether two layouts are of one object: most keypoints of the smaller have one name."""
    shared = match_names(model.keypoints, layout.keypoints)
    return len(shared) >= max(4, _MIN_SHARED * min(len(model), len(layout)))


def matching_model(
    object_layout: KeypointLayout | str, preferred: Sequence[Path] = ()
) -> Path | None:
    """Return the file of a model that has the keypoints of an object, None if there is none.

    A model of the very keypoints, in their order, comes before one that shares most of them.

    Args:
        object_layout: layout of the object, or its name as `find_layout` takes it. "numbered",
            which has no names, and what is no layout have no model.
        preferred: model files that come before those of the package.
    """
    if object_layout == NUMBERED:
        return None
    with suppress(ValueError):
        layout = object_layout
        if isinstance(layout, str):
            layout = find_layout("object", layout)
        found: list[Path] = []
        for path in (*preferred, *shipped_models()):
            with suppress(ModelFileError):
                if path.suffix != MODEL_SUFFIX:
                    continue
                own = load_once(path).layout
                if own.keypoints == layout.keypoints:
                    return path
                if knows(own, layout):
                    found.append(path)
        if found:
            return found[0]
    return None


def model_of_count(keypoints: int) -> str:
    """Return the name of the package's one model of another object than people with so many.

    "" if there is none, or if several layouts have that number of keypoints.
    """
    layouts = [layout for layout in LAYOUTS.values() if len(layout) == keypoints]
    if len(layouts) != 1 or knows(layouts[0], HUMAN25):
        return ""
    file = matching_model(layouts[0])
    return file.stem if file else ""


def map_to_model(source: KeypointLayout, target: KeypointLayout) -> KeypointMap:
    """Return the map from a detector's layout to that of a model.

    Raises:
        TooFewSharedError: they share too few keypoints; the text names a model that would do.
    """
    try:
        return KeypointMap(source, target)
    except TooFewSharedError as error:
        file = matching_model(source)
        raise TooFewSharedError(f"{error}{_that_lifts(file, source)}") from None


def _that_lifts(file: Path | None, layout: KeypointLayout) -> str:
    """Return a sentence on the model that lifts a layout; "" if there is none."""
    if file is None:
        return ""
    return (
        f"; model {file.stem!r} lifts {layout.name!r} (-p model:={file.stem}, --model {file.stem})"
    )
