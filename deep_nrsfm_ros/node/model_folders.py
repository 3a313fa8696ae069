"""Where models are looked for."""

from __future__ import annotations

import os
import sys
from pathlib import Path

PACKAGE = "deep_nrsfm_ros"


def default_models_dir() -> Path:
    """Return the folder for a user's own models: $ROS_HOME/deep_nrsfm_ros/models.

    ROS_HOME is ~/.ros unless it is set, as for everything else that ROS keeps for a user.
    """
    home = os.environ.get("ROS_HOME")
    return (Path(home) if home else Path.home() / ".ros") / PACKAGE / "models"


def model_folders(models_dir: Path) -> list[Path]:
    """Return the folders that may hold a model, the first found wins.

    The user's own folder, then share/deep_nrsfm_ros/models of each installation on
    AMENT_PREFIX_PATH and of this Python environment, then models/ of a source tree.
    """
    prefixes = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    shares = [Path(p) / "share" / PACKAGE / "models" for p in (*prefixes, sys.prefix)]
    source_tree = Path(__file__).resolve().parents[2] / "models"
    return [models_dir, *dict.fromkeys(shares), source_tree]
