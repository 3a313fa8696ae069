# SPDX-License-Identifier: Apache-2.0
"""When a lifter switches by itself to the model that it has trained."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17, HUMAN25
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.training.activation import reason_to_stay

FLY = KeypointLayout("fly", ("head", "thorax", "abdomen", "left_wing", "right_wing"))
SIDES = (("left_wing", "right_wing", "thorax", "head"),)


def model_of(layout: KeypointLayout, *, has_start: bool = False) -> Model:
    network = initialise(Architecture(widths=(4,)), len(layout), np.random.default_rng(0))
    provenance = {"from": {"model": "old"}} if has_start else {}
    return Model(
        "new", network, layout, Normaliser(), np.eye(3, dtype=np.float32), provenance=provenance
    )


def with_sides() -> KeypointLayout:
    return KeypointLayout("fly", FLY.keypoints, handedness=SIDES)


@pytest.mark.parametrize(
    ("new", "present", "reasons"),
    [
        (model_of(HUMAN25), model_of(HUMAN25), []),
        (model_of(HUMAN17), model_of(HUMAN25), []),  # both are of people
        (model_of(with_sides()), model_of(FLY), []),
        (model_of(FLY, has_start=True), model_of(FLY), []),  # the sides are those of its start
        (
            model_of(FLY),
            model_of(FLY),
            ["'fly' names no handedness", "and set mirrored where they are"],
        ),
        (model_of(with_sides()), model_of(HUMAN25), ["'fly', and the lifter lifts 'human25'"]),
        (model_of(FLY), model_of(HUMAN25), ["the lifter lifts", "mirrored as a whole: look at"]),
    ],
)
def test_it_stays_with_its_object_and_with_a_known_side(
    new: Model, present: Model, reasons: list[str]
) -> None:
    reason = reason_to_stay(new, present)
    assert bool(reason) == bool(reasons)
    for words in reasons:
        assert words in reason
