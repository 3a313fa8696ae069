# SPDX-License-Identifier: Apache-2.0
"""Deep NRSfM for ROS 2: 2D keypoints in, 3D shape and camera out, learned from 2D alone.

Lift the keypoints of n objects with a model that comes with the package:

    from deep_nrsfm_ros import Lifter, load_model

    lifter = Lifter(load_model("human"), layout="coco17")
    lifted = lifter(points)  # (n, 17, 2) pixels -> lifted.shapes (n, 25, 3), lifted.rotations

Importing the package imports nothing else; each name below imports what it needs at its first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"
__all__ = [
    "HistoryOptions",
    "Intrinsics",
    "KeypointLayout",
    "Lifted",
    "Lifter",
    "LiftingOptions",
    "Model",
    "Recipe",
    "VideoLifter",
    "__version__",
    "load_model",
    "save_model",
    "train",
]

if TYPE_CHECKING:
    from deep_nrsfm_ros.data.video_lifter import VideoLifter
    from deep_nrsfm_ros.layouts.layout import KeypointLayout
    from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
    from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter
    from deep_nrsfm_ros.lifting.options import HistoryOptions, LiftingOptions
    from deep_nrsfm_ros.model_files.model_file import Model, load_model, save_model
    from deep_nrsfm_ros.nrsfm.recipe import Recipe
    from deep_nrsfm_ros.training.from_arrays import train

_HOMES = {
    "HistoryOptions": "lifting.options",
    "Intrinsics": "lifting.intrinsics",
    "KeypointLayout": "layouts.layout",
    "Lifted": "lifting.lifter",
    "Lifter": "lifting.lifter",
    "LiftingOptions": "lifting.options",
    "Model": "model_files.model_file",
    "Recipe": "nrsfm.recipe",
    "VideoLifter": "data.video_lifter",
    "load_model": "model_files.model_file",
    "save_model": "model_files.model_file",
    "train": "training.from_arrays",
}


def __getattr__(name: str) -> Any:
    """Return a public name from the module that defines it, which is imported here (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
