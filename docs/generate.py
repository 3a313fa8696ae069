"""Write the reference pages that follow from the code: parameters and keypoint layouts.

Run `make reference` after a change of an option or a layout. A test fails when a page is stale.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from deep_nrsfm_ros.configuration import options
from deep_nrsfm_ros.data.curation import Curation
from deep_nrsfm_ros.layouts.presets import LAYOUTS
from deep_nrsfm_ros.lifting.options import GravityOptions, HistoryOptions, LiftingOptions
from deep_nrsfm_ros.lifting.smoothing import SmoothingOptions
from deep_nrsfm_ros.messages.options import InputOptions
from deep_nrsfm_ros.node.bodies import BodyOptions
from deep_nrsfm_ros.node.camera import CameraOptions
from deep_nrsfm_ros.node.gravity import GravitySources
from deep_nrsfm_ros.node.parameter_bridge import parameter_name
from deep_nrsfm_ros.nrsfm.recipe import LayoutLossWeights, Recipe
from deep_nrsfm_ros.training.limits import Limits
from deep_nrsfm_ros.training.request import TrainingOptions

FOLDER = Path(__file__).parent / "reference"
_HOME = "$ROS_HOME/deep_nrsfm_ros"
_SHOWN = {"models_dir": f"{_HOME}/models", "bags_dir": f"{_HOME}/bags"}
_GROUPS: tuple[tuple[str, type, str], ...] = (
    ("Model and input", InputOptions, ""),
    ("Lifting", LiftingOptions, ""),
    ("Camera", CameraOptions, ""),
    ("Lifting over time", HistoryOptions, "history."),
    ("Gravity", GravityOptions, "gravity."),
    ("Gravity: sources", GravitySources, "gravity."),
    ("Smoothing", SmoothingOptions, "smoothing."),
    ("Joints", BodyOptions, "body."),
    ("Training: data and result", TrainingOptions, "train."),
    ("Training: recipe", Recipe, "train."),
    ("Training: losses of the layout", LayoutLossWeights, "train."),
    ("Training: limits", Limits, "train."),
    ("Training: curation of the data", Curation, "train."),
)


def parameters_page() -> str:
    """Return the page of all parameters of the lifter, in Markdown."""
    parts = [
        "# Parameters of the lifter",
        "Every parameter of `ros2 run deep_nrsfm_ros lifter`. A parameter marked with * is read at "
        "the start and cannot change afterwards. Made by `make reference`; do not edit.",
    ]
    for title, cls, prefix in _GROUPS:
        rows = ["| parameter | default | meaning | allowed |", "|---|---|---|---|"]
        for field, _, opt in options(cls):
            star = "*" if opt.read_only else ""
            allowed = ", ".join(opt.choices) or opt.allowed()
            shown = _SHOWN.get(field.name) or _default(field.default)
            name = parameter_name(field, prefix)
            rows.append(f"| `{name}`{star} | {shown} | {opt.description} | {allowed} |")
        parts += [f"## {title}", "\n".join(rows)]
    return "\n\n".join(parts) + "\n"


def layouts_page() -> str:
    """Return the page of all keypoint layouts, in Markdown."""
    rows = ["| layout | keypoints | picture | in order |", "|---|---|---|---|"]
    rows += [
        f"| `{preset.name}` | {len(preset)} | [picture](layouts/{preset.name}.png) | "
        f"{', '.join(preset.keypoints)} |"
        for preset in LAYOUTS.values()
    ]
    return (
        "# Keypoint layouts\n\nThe presets, each with its keypoints in the order in which they "
        "come. Made by `make reference`; do not edit. A picture has the index "
        "of each keypoint: left is green, right is orange. `python -m docs.draw_layouts` draws "
        "them.\n\n" + "\n".join(rows) + "\n"
    )


PAGES = {"parameters.md": parameters_page, "layouts.md": layouts_page}


def _default(value: Any) -> str:
    return "none" if value == () else "empty" if value == "" else str(value)


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name, page in PAGES.items():
        (FOLDER / name).write_text(page(), encoding="utf-8")
