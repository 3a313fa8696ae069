# SPDX-License-Identifier: Apache-2.0
"""Keypoint layouts by the name of a preset, a layout file or a model file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.layout_file import LAYOUT_SUFFIXES, LayoutFileError, read_layout
from deep_nrsfm_ros.layouts.presets import LAYOUTS, preset
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, load_once
from deep_nrsfm_ros.similar_names import did_you_mean

NUMBERED = "numbered"
"""Stands for a layout of points without names, as many as the data has."""


def find_layout(option: str, name_or_path: str) -> KeypointLayout:
    """Return the keypoint layout that the value of an option stands for.

    Args:
        option: name of the option, for error messages.
        name_or_path: name of a preset, path of a layout file (.yaml), or path of a model file
            (.safetensors), whose layout it is.

    Raises:
        ValueError: the value is none of these, or the file is missing or damaged.
        LayoutFileError: a layout file is wrong, or its layout has the name of a preset.
    """
    if name_or_path in LAYOUTS:
        return preset(name_or_path)
    path = Path(name_or_path).expanduser()
    if path.suffix in LAYOUT_SUFFIXES:
        layout = read_layout(path)
        if layout.name in LAYOUTS:
            raise LayoutFileError(
                f"layout file {path}: name {layout.name!r} is that of a preset; choose another"
            )
        return layout
    if path.suffix == MODEL_SUFFIX:
        return load_once(path).layout
    presets = did_you_mean(name_or_path, LAYOUTS) or ", ".join(LAYOUTS)
    raise ValueError(
        f"{option} is {name_or_path!r}; name a preset ({presets}), "
        f"a layout file ({LAYOUT_SUFFIXES[0]}) or a model file ({MODEL_SUFFIX})"
    )


def layout_of(
    option: str,
    value: KeypointLayout | str | Path | Sequence[str] | NDArray[np.str_],
    name: str = "keypoints",
) -> KeypointLayout:
    """Return the keypoint layout that an argument of the Python API stands for.

    Args:
        option: name of the argument, for error messages.
        value: a layout, what `find_layout` takes, as a string or a path, or the names of the
            keypoints in the order of the arrays, as a sequence or an array of texts.
        name: name of a layout that is made of the names of keypoints.

    Raises:
        TypeError: the value is none of these.
        ValueError: see `find_layout`; or a name of a keypoint is empty or there twice.
    """
    if isinstance(value, KeypointLayout):
        return value
    if isinstance(value, (str, Path)):
        return find_layout(option, str(value))
    if isinstance(value, np.ndarray) and value.ndim == 1:  # of an .npz
        value = value.tolist()
    if isinstance(value, Sequence) and all(isinstance(each, str) for each in value):
        return KeypointLayout(name, tuple(value))
    raise TypeError(
        f"{option} is a {type(value).__name__}; give a KeypointLayout, the name of a preset, a "
        "layout file (.yaml), or a list of the keypoints' names"
    )
