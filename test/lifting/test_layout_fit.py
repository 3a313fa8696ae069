# SPDX-License-Identifier: Apache-2.0
"""The layout that fits is found among those of the same number of keypoints."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.data.walking_person import in_layout
from deep_nrsfm_ros.data.clip import read_clip
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import COCO17, HUMAN17, LAYOUTS
from deep_nrsfm_ros.lifting.layout_fit import (
    LayoutFit,
    ambiguity,
    better_layout,
    choose_layout,
    fit_layouts,
)
from deep_nrsfm_ros.model_files.model_file import Model, load_model


@pytest.fixture(scope="module")
def human() -> Model:
    return load_model("human")


@pytest.mark.parametrize("name", ["human17", "coco17"])
def test_the_layout_of_seventeen_keypoints(human: Model, name: str) -> None:
    points, confidence = in_layout(LAYOUTS[name], 40)
    fits = fit_layouts(points, confidence, human)
    assert {"human17", "coco17"} <= {fit.layout.name for fit in fits}
    assert fits[0].layout.name == name and fits[0].residual < 0.2
    for preferred in (HUMAN17, COCO17):
        chosen = choose_layout(fits, preferred)
        assert chosen and chosen.layout.name == name
    assert better_layout(fits, LAYOUTS[name], fits[0].residual) is None
    other = next(fit for fit in fits if fit.layout.name in {"human17", "coco17"} - {name})
    finding = better_layout(fits, other.layout, other.residual)
    assert finding and f"is it {name}? It fits {fits[0].residual:.2f}" in finding.message


def test_a_layout_that_is_no_preset_is_called_that_of_the_model() -> None:
    fits = [LayoutFit(KeypointLayout("mymouse", ("a", "b", "c", "d")), 0.05)]
    finding = better_layout(fits, COCO17, 0.8)
    assert (
        finding
        and "set the keypoint layout to that of the model (-p keypoint_layout:=model"
        in (finding.message)
    )


@pytest.mark.parametrize("name", ["coco17", "posetrack18_17"])
def test_a_layout_without_some_keypoints_of_another_is_told_from_it(
    human: Model, name: str
) -> None:
    columns = [LAYOUTS["body25b"].index(keypoint) for keypoint in LAYOUTS[name].keypoints]
    for view in read_clip().session.views:
        found = fit_layouts(view.points[:, columns], view.confidence[:, columns], human)
        assert found[0].layout.name == name


def test_keypoints_of_which_no_layout_is_known(human: Model) -> None:
    points = np.random.default_rng(0).uniform(0, 500, (20, 17, 2)).astype(np.float32)
    ones = np.ones((20, 17), np.float32)
    fits = fit_layouts(points, ones, human)
    chosen = choose_layout(fits, HUMAN17)
    assert chosen and chosen.layout.name == "human17"
    assert better_layout(fits, HUMAN17, chosen.residual) is None
    assert not fit_layouts(points[:, :7], ones[:, :7], human)
    assert choose_layout([], HUMAN17) is None
    assert better_layout([], HUMAN17, 0.8) is None
    assert not fit_layouts(points, 0 * ones, human)


def test_a_layout_of_the_caller(human: Model) -> None:
    points, confidence = in_layout(COCO17, 20)
    turned = KeypointLayout("turned", COCO17.keypoints[::-1])
    fits = fit_layouts(*KeypointMap(COCO17, turned)(points, confidence), human, [turned])
    assert fits[0].layout is turned


def test_two_layouts_that_may_be_meant_are_ambiguous(human: Model) -> None:
    points, confidence = in_layout(COCO17, 40)
    fits = fit_layouts(points, confidence, human)
    chosen = choose_layout(fits, HUMAN17)
    assert chosen and chosen.layout.name == "coco17"
    # posetrack18_17 fits alike and is coco17 without the eyes, so it is no other layout.
    assert ambiguity(points, confidence, human, fits, chosen) is None


def test_too_few_keypoints_to_try_a_layout_are_ambiguous() -> None:
    model = load_model("human17")
    points, upper = in_layout(COCO17, 40)
    upper[:, 7:] = 0  # head and shoulders alone: three keypoints of the model
    fits = fit_layouts(points, upper, model)
    chosen = choose_layout(fits, HUMAN17)
    assert chosen and chosen.layout.name != "coco17"
    finding = ambiguity(points, upper, model, fits, chosen)
    assert finding and finding.code == "ambiguous-layout"
    assert "coco17 (too few visible keypoints to try it)" in finding.message
