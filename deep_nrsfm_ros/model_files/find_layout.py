"""Keypoint layouts by the name of a preset, an object file or a model file."""

from __future__ import annotations

from pathlib import Path

from deep_nrsfm_ros.layouts.keypoint_layout import LAYOUTS, KeypointLayout
from deep_nrsfm_ros.layouts.object_file import OBJECT_SUFFIXES, read_object
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, load_model

NUMBERED = "numbered"
"""Stands for an object that nobody has described, where its points tell how many they are."""


def find_layout(option: str, word: str) -> KeypointLayout:
    """Return the layout that `word`, given by `option`, stands for.

    word: the name of a preset, the path of an object file, or that of a model file, which gives
        the layout of its model. Raises ValueError for anything else, or for a damaged file.
    """
    if word in LAYOUTS:
        return LAYOUTS[word]
    path = Path(word).expanduser()
    if path.suffix in OBJECT_SUFFIXES:
        return read_object(path)
    if path.suffix == MODEL_SUFFIX:
        return load_model(path).layout
    raise ValueError(
        f"{option} is {word!r}; name a preset ({', '.join(LAYOUTS)}), "
        f"an object file ({OBJECT_SUFFIXES[0]}) or a model file ({MODEL_SUFFIX})"
    )
