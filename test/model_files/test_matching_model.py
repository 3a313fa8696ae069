# SPDX-License-Identifier: Apache-2.0
"""The model that a training starts from: one whose keypoints have the names of the object's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deep_nrsfm_ros.layouts.keypoint_map import TooFewSharedError
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17, LAYOUTS
from deep_nrsfm_ros.model_files import model_file
from deep_nrsfm_ros.model_files.matching_model import (
    knows,
    map_to_model,
    matching_model,
    model_of_count,
)
from deep_nrsfm_ros.model_files.model_file import (
    Model,
    ModelFileError,
    load_model,
    load_once,
    save_model,
)
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser

DOG = KeypointLayout("dog", ("nose", "tail", "left_paw", "right_paw", "back"))


def save(path: Path, layout: KeypointLayout) -> Path:
    network = initialise(Architecture(widths=(4,)), len(layout), np.random.default_rng(0))
    model = Model("any", network, layout, Normaliser(), np.eye(3, dtype=np.float32))
    save_model(path, model)
    return path


def test_a_file_is_read_once_until_it_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, read = save(tmp_path / "dog.safetensors", DOG), []

    def counted(file: Path) -> Model:
        read.append(file)
        return load_model(file)

    monkeypatch.setattr(model_file, "load_model", counted)
    assert load_once(path) is load_once(path) and len(read) == 1
    assert matching_model(DOG, [path]) == path and len(read) == 1
    save(path, HUMAN17)
    assert load_once(path).layout.keypoints == HUMAN17.keypoints and len(read) == 2
    with pytest.raises(ModelFileError, match="cannot read"):
        load_once(tmp_path / "none.safetensors")


def test_a_number_of_keypoints_that_one_object_has_names_its_model() -> None:
    assert model_of_count(21) == "hand21"
    # Of people several layouts have these; of 1000 keypoints there is no layout.
    assert [model_of_count(count) for count in (17, 25, 1000)] == [""] * 3


def test_layouts_of_different_objects_name_the_model_that_would_do() -> None:
    hand, human = LAYOUTS["hand21"], LAYOUTS["human25"]
    with pytest.raises(TooFewSharedError, match=r"; model 'hand21' lifts .*-p model:=hand21, --m"):
        map_to_model(hand, human)
    with pytest.raises(TooFewSharedError, match=r"\.\.\.$"):  # no model lifts it
        map_to_model(DOG, hand)
    assert map_to_model(hand, hand).identical


@pytest.mark.parametrize("name", ["coco17", "body25", "body25b", "mediapipe33", "halpe26"])
def test_people_of_every_detector_have_human(name: str) -> None:
    if name not in LAYOUTS:
        pytest.skip(f"there is no layout {name}")
    found = matching_model(name)
    assert found is not None and found.stem == "human"


@pytest.mark.parametrize("name", ["human17", "human25", "cmu31", "hand21"])
def test_a_model_of_the_very_keypoints_comes_before_one_that_shares_most(name: str) -> None:
    found = matching_model(name)
    assert found is not None and load_model(found).layout.keypoints == LAYOUTS[name].keypoints


@pytest.mark.parametrize("name", ["hand21", "ap10k17", "numbered", "no such layout"])
def test_other_objects_have_no_model_of_people(name: str) -> None:
    found = matching_model(name)
    assert found is None or found.stem != "human"


def test_the_present_model_comes_first_if_it_fits(tmp_path: Path) -> None:
    dog, mine = save(tmp_path / "dog.safetensors", DOG), save(tmp_path / "m.safetensors", HUMAN17)
    assert matching_model(DOG, [mine, dog]) == dog
    assert matching_model("human17", [dog, mine]) == mine
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(b"\0" * 9)
    assert matching_model(DOG, [damaged, tmp_path / "lost.safetensors", dog]) == dog


def test_most_names_must_be_the_same() -> None:
    points = KeypointLayout("other", ("nose", "tail", "left_paw", "ear", "eye"))
    assert knows(DOG, DOG) and not knows(DOG, points)  # 3 of 5
    assert knows(DOG, KeypointLayout("more", (*DOG.keypoints[:4], "eye")))  # 4 of 5
    few = KeypointLayout("few", DOG.keypoints[:3])
    assert not knows(few, few)  # fewer than 4 are no shape
