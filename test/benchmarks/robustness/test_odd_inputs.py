# SPDX-License-Identifier: Apache-2.0
"""No odd input gives wrong values without a word; those that are read come out right."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.data.odd_files import CASES, Case
from benchmarks.robustness.odd_inputs import by_lift, by_lifter, by_train
from deep_nrsfm_ros.data.keypoint_files import is_bag
from deep_nrsfm_ros.model_files.model_file import load_model

NOT_READ = {
    "YOLO labels (ultralytics 6641)": "YOLO labels",
    "pickle of VIBE": "it is a pickle",
    "array of rows (f, 3q)": "save points.reshape(30, 17, 3)",
    "array (f, 3, q)": "save points.transpose(0, 2, 1)",
    "array (3, q, f) of MATLAB": "save points.transpose(2, 1, 0)",
    "folder of folders (pose2sim 120)": "cam1_json, cam2_json",
    "right before left, without names": "left and right look exchanged",
    "two cameras in a folder (pose2sim 120)": "2 series (logi_*.json, osmo_*.json)",
    "confidence in percent, guessed legs": "poor fit",
    "pixels of the crop": "are not in their box",
    "y before x, normalised": "lie on their side",
    "keypoints at (-1, -1)": "lie at exactly (-1, -1)",
}
"""Inputs that `lift` does not get right, and what it says of them."""


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_lift(case: Case, tmp_path: Path) -> None:
    answer = by_lift(case.write(tmp_path), case, tmp_path)
    if case.name in NOT_READ:
        assert answer.outcome == "said" and NOT_READ[case.name] in answer.said
    else:
        assert answer.outcome == "worked", answer


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_train(case: Case, tmp_path: Path) -> None:
    answer = by_train(case.write(tmp_path), case)
    assert answer.outcome != "silent", answer


@pytest.mark.parametrize("case", [c for c in CASES if c.kind == "bags"], ids=lambda case: case.name)
def test_the_steps_of_the_lifter(case: Case, tmp_path: Path) -> None:
    path = case.write(tmp_path)
    assert is_bag(path)
    answer = by_lifter(path, case, load_model("human"))
    assert answer.outcome == ("said" if case.name in NOT_READ else "worked"), answer
