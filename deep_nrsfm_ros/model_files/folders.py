# SPDX-License-Identifier: Apache-2.0
"""Where models, bags and layout files are looked for."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

PACKAGE = "deep_nrsfm_ros"

_SOURCE_TREE = Path(__file__).resolve().parents[2]


def default_models_dir() -> Path:
    """Return the folder for a user's own models: $ROS_HOME/deep_nrsfm_ros/models.

    ROS_HOME is ~/.ros unless it is set, as for everything else that ROS keeps for a user.
    """
    return _ros_home() / PACKAGE / "models"


def default_bags_dir() -> Path:
    """Return the folder for bags to train on: $ROS_HOME/deep_nrsfm_ros/bags."""
    return _ros_home() / PACKAGE / "bags"


def model_folders(models_dir: Path) -> list[Path]:
    """Return the folders that may hold a model, the first found wins.

    The user's own folder, then share/deep_nrsfm_ros/models of each installation on
    AMENT_PREFIX_PATH and of this Python environment, then models/ of a source tree.
    """
    return [models_dir, *_shared("models"), _SOURCE_TREE / "models"]


def in_words(folders: Sequence[Path]) -> str:
    """Return folders of models for a message; those of the package are "the package's models"."""
    own = model_folders(Path())[1:]
    words = ["the package's models" if folder in own else str(folder) for folder in folders]
    return ", ".join(dict.fromkeys(words))


def shipped_models() -> list[Path]:
    """Return the model files that come with the package, each name once."""
    files: dict[str, Path] = {}
    for folder in [*_shared("models"), _SOURCE_TREE / "models"]:
        for path in sorted(folder.glob("*.safetensors")):
            files.setdefault(path.name, path)
    return list(files.values())


def layout_folders() -> list[Path]:
    """Return the folders of the layout files that come with the package."""
    return [*_shared("config/layouts"), _SOURCE_TREE / "config" / "layouts"]


def mapping_folders() -> list[Path]:
    """Return the folders of the field mappings that come with the package."""
    return [*_shared("config/mappings"), _SOURCE_TREE / "config" / "mappings"]


def _ros_home() -> Path:
    home = os.environ.get("ROS_HOME")
    return Path(home) if home else Path.home() / ".ros"


def _shared(folder: str) -> list[Path]:
    """Return a folder of each installation of this package, once each."""
    prefixes = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    return [*dict.fromkeys(Path(p) / "share" / PACKAGE / folder for p in (*prefixes, sys.prefix))]
