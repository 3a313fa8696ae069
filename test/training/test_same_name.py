# SPDX-License-Identifier: Apache-2.0
"""What becomes of the model that has the name of a new one."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.layouts.presets import COCO17, HAND21, HUMAN25
from deep_nrsfm_ros.model_files.folders import model_folders, shipped_models
from deep_nrsfm_ros.model_files.model_file import Model, save_model
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.training.judge import Figures, Judgement
from deep_nrsfm_ros.training.same_name import (
    CUT_OFF,
    check_not_shipped,
    keep_before,
    name_beside,
    old_model,
)

FIGURES = Figures(*[0.1] * 9)
DOUBTED, BETTER = Judgement("worse", "", FIGURES), Judgement("", "it is better", FIGURES)
UNCOMPARED = Judgement("", "it cannot be compared", FIGURES, verdict="unknown")


def save(folder: Path, **provenance: Any) -> Path:
    network = initialise(Architecture(widths=(4,)), len(COCO17), np.random.default_rng(0))
    path, frame = folder / "mine.safetensors", np.eye(3, dtype=np.float32)
    save_model(path, Model("mine", network, COCO17, Normaliser(), frame, provenance))
    return path


@pytest.mark.parametrize(
    ("provenance", "is_good"),
    [
        ({}, True),  # of an earlier version, or of motion capture
        ({"judgement": {"doubtful": False}}, True),
        ({"judgement": {"doubtful": True}}, False),
        ({"judgement": {"doubtful": False, "first_look": True}}, False),
        ({"judgement": {"doubtful": False, "fits_badly": True}}, False),
        ({"judgement": {"doubtful": False, "verdict": "unknown"}}, True),
        ({CUT_OFF: True}, False),
    ],
)
def test_a_finished_model_that_nobody_doubts_is_good(
    provenance: dict[str, Any], is_good: bool, tmp_path: Path
) -> None:
    assert old_model(tmp_path, "mine") is None
    save(tmp_path, **provenance)
    old = old_model(tmp_path, "mine")
    assert old and old.is_good == is_good and old.is_rival(HUMAN25) == is_good
    assert not old.is_rival(HAND21)  # of another object


def test_a_model_of_another_object_gives_its_name(tmp_path: Path) -> None:
    save(tmp_path)
    old = old_model(tmp_path, "mine")
    assert old and old.is_at_stake(HUMAN25, DOUBTED) and not old.is_at_stake(HAND21, DOUBTED)
    assert old.is_at_stake(HAND21, None)  # it was cut off


def test_a_file_that_cannot_be_read_is_kept_but_is_no_rival(tmp_path: Path) -> None:
    (tmp_path / "mine.safetensors").write_bytes(b"of another version")
    old = old_model(tmp_path, "mine")
    assert old and not old.is_good and not old.is_rival(COCO17)
    assert keep_before(old.path) == "mine_before"
    assert (tmp_path / "mine_before.safetensors").read_bytes() == b"of another version"


def test_only_what_is_not_doubtful_takes_the_name(tmp_path: Path) -> None:
    save(tmp_path)
    old = old_model(tmp_path, "mine")
    assert [name_beside("mine", old, each) for each in (BETTER, DOUBTED, UNCOMPARED, None)] == [
        "mine",
        "mine_doubtful",
        "mine_new",
        "mine_unfinished",
    ]
    assert {name_beside("mine", None, each) for each in (BETTER, DOUBTED, None)} == {"mine"}


@pytest.mark.parametrize("has_links", [True, False])
def test_the_last_one_is_kept_with_its_report(
    has_links: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise PermissionError

    if not has_links:
        monkeypatch.setattr(os, "link", refuse)
    for step in (1, 2):
        path = save(tmp_path, step=step)
        path.with_suffix(".html").write_text(f"report {step}")
        keep_before(path)
    kept = tmp_path / "mine_before.safetensors"
    assert kept.read_bytes() == path.read_bytes()
    save(tmp_path, step=3)
    assert kept.read_bytes() != path.read_bytes()
    assert kept.with_suffix(".html").read_text() == "report 2"
    path.with_suffix(".html").unlink()
    keep_before(path)
    names = ["mine.safetensors", "mine_before.safetensors"]
    assert sorted(file.name for file in tmp_path.iterdir()) == names  # no report of another model


def test_the_names_of_the_package_are_its_own(tmp_path: Path) -> None:
    for path in shipped_models():
        with pytest.raises(ValueError, match=f"train.name is '{path.stem}', the name of a model"):
            check_not_shipped("train.name", path.stem, tmp_path)
        check_not_shipped("train.name", path.stem, model_folders(tmp_path)[-1])
    check_not_shipped("train.name", "my_human", tmp_path)
