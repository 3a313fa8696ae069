# SPDX-License-Identifier: Apache-2.0
"""What is refused before data are read, in the words of the command line and of the service."""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.data.bags import frames, write_bag
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import COCO17
from deep_nrsfm_ros.model_files.model_file import Model, save_model
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.training.config import COMMAND_LINE, PARAMETERS, TrainingConfig
from deep_nrsfm_ros.training.validation import validate
from deep_nrsfm_ros.wording import in_node


def save(path: Path, layout: KeypointLayout) -> Path:
    network = initialise(Architecture(widths=(4,)), len(layout), np.random.default_rng(0))
    frame = np.eye(3, dtype=np.float32)
    save_model(path, Model("m", network, layout, Normaliser(), frame))
    return path


@pytest.fixture
def config(tmp_path: Path) -> TrainingConfig:
    detections = np.ones((2, 17, 2)), np.ones((2, 17))
    write_bag(tmp_path / "bag", "/keypoints", frames(*detections))
    bags = (tmp_path / "bag",)
    values = {"bags": bags, "keypoint_layout": "coco17", "folder": tmp_path / "models"}
    return TrainingConfig().with_options(values)


@pytest.mark.parametrize("name", ["", ".", "../up", "a/b", "-x", "a b", "x" * 101])
def test_a_name_that_is_no_plain_file_name_is_refused(config: TrainingConfig, name: str) -> None:
    for names, word in ((COMMAND_LINE, "--name"), (PARAMETERS, r"train\.name")):
        with pytest.raises(ValueError, match=f"{word} is "):
            validate(config.with_options({"name": name}), names)


@pytest.mark.parametrize(
    ("changes", "on_command_line", "as_parameter"),
    [
        ({"bags": ()}, "train on: --bag .*, or --cmu with", "train on: train.bags"),
        ({"cmu": Path("/")}, "train on: --bag .*, or --cmu with", "train on: train.bags"),
        ({"bags": (Path("/nowhere"),)}, "--bag names /nowhere, which", "train.bags names /nowhere"),
        (
            {"topic": "/x"},
            "--topic is '/x': .* no topic called /x; its topics",
            "train.topic is '/x'",
        ),
        (
            {"inputs": (Path("/nowhere"),)},
            "--input names /nowhere, which",
            "train.inputs names /no",
        ),
        ({"object": "horse"}, "--object is 'horse'; name a preset", "train.object is 'horse'"),
        (
            {"keypoint_layout": "horse"},
            "--keypoint-layout is 'horse'; name a preset",
            "train.keypoint_layout is 'horse'; name a preset",
        ),
        (
            {"virtual_people": 9},
            "--virtual-people has no effect on bags",
            "train.virtual_people has",
        ),
        (
            {"hidden_face": 0.2},
            "--hidden-face has no effect on bags",
            "train.hidden_face has no effect on bags",
        ),
        ({"mirrored_images": 2.0}, "--mirrored-images is 2", "train.mirrored_images is 2"),
        ({"steps": 0}, "--steps is 0: .* with --from", "train.steps is 0"),
        ({"object": "cmu31"}, "share 0 keypoints", "share 0 keypoints"),
        ({"object": "numbered"}, "leave out --keypoint-layout", "leave out train.keypoint_layout"),
        ({"learning_rate": 7.0}, "--learning-rate is 7.0", "train.learning_rate is 7.0"),
        ({"outlier_threshold": -1.0}, "--outlier-threshold is -1", "train.outlier_threshold is -1"),
        ({"min_confidence": -1.0}, "--min-confidence is -1", "^min_confidence is -1"),
        (
            {"object": "numbered", "keypoint_layout": "", "bone_length_weight": 1.0},
            "--bone-length-weight is 1, but layout 'numbered' has no edges",
            "train.bone_length_weight is 1, but layout 'numbered' has no edges",
        ),
        (
            {"limb_exchange": 1.0, "object": "numbered", "keypoint_layout": ""},
            "--limb-exchange is 1, but layout .numbered. has no limbs: .*; give it edges .*, or",
            "train.limb_exchange is 1, but layout 'numbered' has no limbs",
        ),
        (
            {"limb_exchange": -0.5},
            "--limb-exchange is -0.5; it must be -1 or",
            "train.limb_exchange is -0.5; it must be",
        ),
        ({"free_disk": 1e9}, r"needs 1000000000 MB \(--free-disk\)", r"\(train.free_disk\)"),
        ({"start": "/gone.safetensors"}, "cannot read model", "cannot read model"),
    ],
)
def test_the_caller_reads_the_name_that_it_has_set(
    config: TrainingConfig, changes: dict[str, Any], on_command_line: str, as_parameter: str
) -> None:
    for names, complaint in ((COMMAND_LINE, on_command_line), (PARAMETERS, as_parameter)):
        caller = in_node() if names is PARAMETERS else nullcontext()
        with caller, pytest.raises(ValueError, match=complaint):
            validate(config.with_options(changes), names)


def test_a_start_is_checked(config: TrainingConfig, tmp_path: Path) -> None:
    coco = config.with_start(save(tmp_path / "coco.safetensors", COCO17))
    assert validate(coco, PARAMETERS) == ""
    with pytest.raises(ValueError, match=r"train\.widths is \(8,\); model 'coco'"):
        validate(coco.with_options({"widths": (8,)}), PARAMETERS)
    points = config.with_start(save(tmp_path / "points.safetensors", KeypointLayout.numbered(5)))
    with pytest.raises(ValueError, match="and layout 'human17' share 0 keypoints"):
        validate(dataclasses.replace(points, object="human17"), PARAMETERS)


def test_a_layout_without_handedness_is_a_warning_unless_a_start_passes_its_own_on(
    config: TrainingConfig, tmp_path: Path
) -> None:
    assert validate(config, COMMAND_LINE) == ""
    coco = config.with_options({"object": "coco17"})
    assert "'coco17' names no handedness" in validate(coco, COMMAND_LINE)
    assert validate(coco.with_start(save(tmp_path / "m.safetensors", COCO17)), COMMAND_LINE) == ""
    numbered = config.with_options({"object": "numbered", "keypoint_layout": ""})
    assert "'numbered' names no handedness" in validate(numbered, PARAMETERS)


def test_layouts_without_a_common_name_are_refused_with_both_remedies(
    config: TrainingConfig, tmp_path: Path
) -> None:
    (tmp_path / "fly.yaml").write_text("{name: fly, keypoints: [a, b, c, d, e, f, g, h]}")
    values = {"object": str(tmp_path / "fly.yaml"), "keypoint_layout": "coco17"}
    remedies = (
        r"'fly' has a, b, c, d, e, f, \.\.\.; set train\.keypoint_layout to the layout of the "
        r"recorded keypoints, for which 'coco17' is taken now, or train\.object"
    )
    with pytest.raises(ValueError, match=remedies):
        validate(config.with_options(values), PARAMETERS)
