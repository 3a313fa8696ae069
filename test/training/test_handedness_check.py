# SPDX-License-Identifier: Apache-2.0
"""Lifted keypoints that disagree on the depth are warned of."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.training import handedness_check
from deep_nrsfm_ros.training.handedness_check import handedness_warning
from test.fixtures.random_model import random_frames, random_model

P = 10


def test_depth_is_doubted_where_keypoints_contradict_each_other() -> None:
    seen = random_frames(40, P)
    names = seen.layout.keypoints
    four, inside_out = (
        (names[0], names[1], names[2], names[3]),
        (names[1], names[0], names[2], names[3]),
    )
    told = [
        handedness_warning(
            random_model(KeypointLayout("thing", names, handedness=handedness)), seen
        )
        for handedness in ((four,), (inside_out,), (four, inside_out), ())
    ]
    # One of two that are each other's mirror image is wrong, and both of both.
    assert sorted(map(bool, told[:2])) == [False, True]
    assert told[2].count(names[3]) == 2 and "disagree" in told[2]
    assert told[3] == ""


def test_what_no_model_lifts_is_not_doubted() -> None:
    nothing = random_frames(5, P)
    nothing.visible[:] = False
    assert handedness_warning(random_model(nothing.layout), nothing) == ""


@pytest.mark.parametrize(
    ("shares", "said"), [([0.5, 1], ""), ([0.04, 1], "(nose in 4 %, left_knee in 100 % of")]
)
def test_a_part_that_is_on_the_wrong_side_is_named_with_its_share(
    shares: list[float], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    fronts = list(zip(("nose", "left_knee"), shares, strict=True))
    monkeypatch.setattr(handedness_check, "front_shares", lambda *_: fronts)
    warning = handedness_check.disagreement(np.zeros((1, 17, 3)), HUMAN17)
    assert (said in warning) and bool(said) == bool(warning)
