# SPDX-License-Identifier: Apache-2.0
"""Models that come with the package and have the keypoints of an object."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.model_files.find_layout import NUMBERED, find_layout
from deep_nrsfm_ros.model_files.folders import shipped_models
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, ModelFileError, load_once

FROM_NONE = "none"
"""Stands for no model to start from: random weights."""

_MIN_SHARED = 0.7  # of the keypoints of the smaller layout; people of all presets have 0.71 or more


def knows(model: KeypointLayout, layout: KeypointLayout) -> bool:
    """Return whether two layouts are of one object: most keypoints of the smaller have one name."""
    shared = set(model.keypoints) & set(layout.keypoints)
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
