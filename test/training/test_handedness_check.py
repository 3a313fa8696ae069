# SPDX-License-Identifier: Apache-2.0
"""Lifted keypoints that disagree on the depth are warned of."""

from __future__ import annotations

import numpy as np

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.training.handedness_check import handedness_warning

P = 10


def model(layout: KeypointLayout) -> Model:
    net = initialise(Architecture(widths=(8, 4)), len(layout), np.random.default_rng(0))
    return Model("mine", net, layout, Normaliser(), np.eye(3, dtype=np.float32))


def frames(f: int, p: int) -> Dataset:
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 500, (f, p, 2)).astype(np.float32)
    return Dataset(points, rng.random((f, p)) < 0.9, KeypointLayout.numbered(p), "made up")


def test_depth_is_doubted_where_keypoints_contradict_each_other() -> None:
    seen = frames(40, P)
    names = seen.layout.keypoints
    four, inside_out = (
        (names[0], names[1], names[2], names[3]),
        (names[1], names[0], names[2], names[3]),
    )
    told = [
        handedness_warning(model(KeypointLayout("thing", names, handedness=handedness)), seen)
        for handedness in ((four,), (inside_out,), (four, inside_out), ())
    ]
    # One of two that are each other's mirror image is wrong, and both of both.
    assert sorted(map(bool, told[:2])) == [False, True]
    assert told[2].count(names[3]) == 2 and "disagree" in told[2]
    assert told[3] == ""


def test_what_no_model_lifts_is_not_doubted() -> None:
    nothing = frames(5, P)
    blind = Dataset(nothing.points, np.zeros((5, P), bool), nothing.layout, "made up")
    assert handedness_warning(model(nothing.layout), blind) == ""
