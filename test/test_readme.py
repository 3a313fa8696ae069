"""The README's tables say what the code says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from deep_nrsfm_ros.configuration import options
from deep_nrsfm_ros.data.curation import Curation
from deep_nrsfm_ros.layouts.keypoint_layout import LAYOUTS, KeypointLayout
from deep_nrsfm_ros.lifting.lifter import LiftingOptions
from deep_nrsfm_ros.lifting.smoothing import SmoothingOptions
from deep_nrsfm_ros.messages.pipeline import InputOptions
from deep_nrsfm_ros.node.camera import CameraOptions
from deep_nrsfm_ros.node.parameters import name_of
from deep_nrsfm_ros.nrsfm.recipe import LayoutLossWeights, Recipe
from deep_nrsfm_ros.training.limits import Limits
from deep_nrsfm_ros.training.request import TrainingOptions

README = (Path(__file__).parents[1] / "README.md").read_text()


def parameter_rows(cls: type, prefix: str) -> list[str]:
    rows = []
    for field, _, opt in options(cls):
        default: Any = field.default
        home = "$ROS_HOME/deep_nrsfm_ros"
        shown = {"models_dir": f"{home}/models", "bags_dir": f"{home}/bags"}
        shown |= {(): "none", "": "empty"}
        text = shown.get(field.name) or shown.get(default, default)
        star = "*" if opt.read_only else ""
        rows.append(f"| `{name_of(field, prefix)}`{star} | {text} | {opt.description} |")
    return rows


@pytest.mark.parametrize(
    ("cls", "prefix"),
    [
        (InputOptions, ""),
        (LiftingOptions, ""),
        (CameraOptions, ""),
        (SmoothingOptions, "smoothing."),
        (TrainingOptions, "train."),
        (Recipe, "train."),
        (LayoutLossWeights, "train."),
        (Limits, "train."),
        (Curation, "train."),
    ],
)
def test_lists_every_parameter(cls: type, prefix: str) -> None:
    for row in parameter_rows(cls, prefix):
        assert row in README


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_lists_every_layout_in_order(layout: KeypointLayout) -> None:
    assert f"| `{layout.name}` | {len(layout)} | {', '.join(layout.keypoints)} |" in README
