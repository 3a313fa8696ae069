# SPDX-License-Identifier: Apache-2.0
"""The parameters of the lifter become the configuration of a training."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.configuration import options
from deep_nrsfm_ros.data.bags import frames, write_bag
from deep_nrsfm_ros.data.curation import Curation
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.model_files.matching_model import matching_model
from deep_nrsfm_ros.model_files.model_file import Model, save_model
from deep_nrsfm_ros.model_files.path_sandbox import PathSandbox
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import LayoutLossWeights, Recipe
from deep_nrsfm_ros.training.config import DataConfig, OutputConfig, TrainingConfig
from deep_nrsfm_ros.training.limits import Limits
from deep_nrsfm_ros.training.record import keep_record
from deep_nrsfm_ros.training.request import (
    LifterInput,
    TrainingOptions,
    TrainingParameters,
    TrainingRequest,
    choose_layouts,
    choose_topic,
    data_in_words,
    training_request,
)

MODEL = Path("present.safetensors")
PARTS = TrainingParameters(
    TrainingOptions(),
    Recipe(steps=77, added_noise=0.25),
    LayoutLossWeights(bone_length_weight=1.5),
    Limits(minutes=2.5, patience=0.25, keep_best=False),
    Curation(min_visible=7, min_change=0.25),
)
MAPPING = str(Path(__file__).parents[2] / "config" / "mappings" / "media_pipe_ros2.yaml")
INPUT = LifterInput("/camera/keypoints", "coco17", MODEL, 0.25, MAPPING, 640, 480)


def request(folder: Path, **options: Any) -> TrainingRequest:
    """Return what a lifter whose folders are `folder` is asked for."""
    wanted: dict[str, Any] = {"object": "human17", **options}
    parts = dataclasses.replace(PARTS, options=dataclasses.replace(TrainingOptions(), **wanted))
    return training_request(parts, INPUT, PathSandbox(folder, folder))


def test_every_parameter_reaches_the_configuration(tmp_path: Path) -> None:
    words = {"name": "mine", "threads": 3, "resume": True, "activate": "never", "hands": "palms"}
    asked = request(tmp_path, bags=("one", "two"), **words)
    human = matching_model("human17")
    assert human is not None
    expected = TrainingConfig(
        data=DataConfig(
            bags=(tmp_path / "one", tmp_path / "two"),
            topic="/camera/keypoints",
            keypoint_layout="coco17",
            min_confidence=0.25,
            mapping=MAPPING,
            image_width=640,
            image_height=480,
            hands="palms",
        ),
        object="human17",
        recipe=PARTS.recipe,
        layout_loss=PARTS.layout_loss,
        curation=PARTS.curation,
        limits=PARTS.limits,
        output=OutputConfig(tmp_path, "mine", 3),
        resume=True,
    )
    assert asked.config == expected.with_start(human)
    assert asked.activate == "never"
    anew = request(tmp_path, from_="none").config
    assert (anew.start, anew.rival) == ("", str(human))
    assert request(tmp_path, topic="/other").config.data.topic == "/other"
    assert request(tmp_path).config.data.hands == ""
    with pytest.raises(ValueError, match="allows at most 2"):
        request(tmp_path, max_minutes=2.0)


def test_files_of_keypoints_are_data_too(tmp_path: Path) -> None:
    np.savez(tmp_path / "people.npz", points=np.ones((20, 17, 2)))
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "people.npz").write_bytes((tmp_path / "people.npz").read_bytes())
    asked = request(tmp_path, inputs=("people.npz", "more"))
    assert asked.config.data.files() == [
        tmp_path / "people.npz",
        tmp_path / "more" / "people.npz",
    ]
    assert (asked.config.data.bags, asked.config.data.topic) == ((), "")  # a file has no topic
    asked.accept()
    assert data_in_words(asked.config.data) == f"{tmp_path}/people.npz, {tmp_path}/more"
    write_bag(tmp_path / "bag", INPUT.topic, frames(np.ones((2, 17, 2)), np.ones((2, 17))))
    both = request(tmp_path, bags=("bag",), inputs=("people.npz",)).config.data
    assert data_in_words(both) == f"{INPUT.topic} of {tmp_path}/bag and {tmp_path}/people.npz"
    assert request(tmp_path, inputs=("bag",)).config.data.topic == INPUT.topic
    with pytest.raises(
        ValueError, match=r"train\.inputs names .*nowhere.npz, which does not exist"
    ):
        request(tmp_path, inputs=("nowhere.npz",)).accept()
    with pytest.raises(ValueError, match=r"train\.inputs names /etc/passwd, .* outside"):
        request(tmp_path, inputs=("/etc/passwd",))
    with pytest.raises(ValueError, match=r"train\.bags and train\.inputs"):
        request(tmp_path).accept()


def test_a_start_brings_its_architecture(tmp_path: Path) -> None:
    architecture = Architecture(widths=(4,))
    network = initialise(architecture, len(HUMAN17), np.random.default_rng(0))
    frame = np.eye(3, dtype=np.float32)
    path = tmp_path / "old.safetensors"
    save_model(path, Model("old", network, HUMAN17, Normaliser(), frame))
    config = request(tmp_path, bags=(".",), from_="old").config
    assert (config.start, config.architecture) == (str(path), architecture)


def test_an_object_that_is_no_preset_starts_from_its_present_model(tmp_path: Path) -> None:
    paw = KeypointLayout("paw", ("heel", "toe_1", "toe_2", "toe_3", "toe_4"))
    network = initialise(Architecture(widths=(4,)), len(paw), np.random.default_rng(0))
    path = tmp_path / "paw.safetensors"
    save_model(path, Model("paw", network, paw, Normaliser(), np.eye(3, dtype=np.float32)))
    lifter = dataclasses.replace(INPUT, model=path)

    def asked(**options: Any) -> TrainingConfig:
        parts = dataclasses.replace(PARTS, options=TrainingOptions(**options))
        return training_request(parts, lifter, PathSandbox(tmp_path, tmp_path)).config

    config = asked()
    assert (config.object, config.start, config.rival) == (str(path),) * 3
    assert config.architecture == network.architecture
    anew = asked(from_="none")
    assert (anew.object, anew.start, anew.rival) == (str(path), "", str(path))
    numbered = asked(object="numbered")
    assert (numbered.start, numbered.rival) == ("", "")


@pytest.mark.parametrize(
    ("options", "lifter_layout", "expected"),
    [
        ({}, "model", (str(MODEL), str(MODEL))),
        ({}, "coco17", ("coco17", str(MODEL))),
        ({"from_": "old.safetensors"}, "model", (str(MODEL), "old.safetensors")),
        ({"from_": "old.safetensors"}, "coco17", ("coco17", "old.safetensors")),
        ({"object": "dog.yaml"}, "model", ("dog.yaml", "dog.yaml")),
        ({"object": "dog.yaml"}, "coco17", ("coco17", "dog.yaml")),
        ({"object": "dog.yaml", "from_": "old.safetensors"}, "model", ("dog.yaml", "dog.yaml")),
        ({"object": "human17", "keypoint_layout": "body25"}, "model", ("body25", "human17")),
        ({"keypoint_layout": "body25"}, "coco17", ("body25", str(MODEL))),
        ({"object": "numbered"}, "coco17", ("", "numbered")),
        ({}, "auto", ("", str(MODEL))),
        ({"keypoint_layout": "body25"}, "auto", ("body25", str(MODEL))),
    ],
)
def test_layouts_are_those_of_the_parameters_or_of_the_lifter(
    options: dict[str, Any], lifter_layout: str, expected: tuple[str, str]
) -> None:
    lifter = dataclasses.replace(INPUT, keypoint_layout=lifter_layout)
    assert choose_layouts(TrainingOptions(**options), lifter) == expected


def write(folder: Path, *topics: str) -> None:
    """Write a bag for each topic, called as its last part."""
    for topic in topics:
        path = folder / topic.split("/")[-1]
        write_bag(path, topic, frames(np.ones((2, 17, 2)), np.ones((2, 17))))


def test_the_only_topic_that_fits_is_taken_where_the_lifters_is_not_recorded(
    tmp_path: Path,
) -> None:
    write(tmp_path, "/camera/keypoints", "/other", "/third")
    for bags, expected in (
        (("keypoints",), "/camera/keypoints"),
        (("other", "keypoints"), "/camera/keypoints"),
        (("other",), "/other"),
        (("other", "third"), ""),
        (("nowhere",), "/camera/keypoints"),
    ):
        lifter = dataclasses.replace(INPUT, mapping="")
        assert choose_topic([tmp_path / bag for bag in bags], lifter) == expected
    assert choose_topic([tmp_path / "other"], dataclasses.replace(INPUT, topic="")) == ""
    with pytest.raises(ValueError, match="train.topic is '/gone': bag .* no topic called /gone"):
        request(tmp_path, bags=("other",), topic="/gone").accept()


def test_a_request_is_validated(tmp_path: Path) -> None:
    write(tmp_path, "/camera/keypoints")
    with pytest.raises(ValueError, match=r"train\.bags"):
        request(tmp_path).accept()
    with pytest.raises(ValueError, match="nowhere"):
        request(tmp_path, bags=("keypoints", "nowhere")).accept()
    asked = request(tmp_path, bags=("keypoints",))
    assert asked.accept() == (asked.config, "")


def test_resuming_keeps_to_the_record_and_tells_what_differs(tmp_path: Path) -> None:
    asked = request(tmp_path, resume=True, name="mine", threads=2)
    with pytest.raises(ValueError, match=r"no unfinished training of 'mine'.*\(unfinished: none\)"):
        asked.accept()
    write(tmp_path, "/camera/keypoints")
    recorded = dataclasses.replace(
        asked.config,
        data=dataclasses.replace(asked.config.data, bags=(tmp_path / "keypoints",)),
        recipe=Recipe(steps=30, added_noise=0.25),
        output=OutputConfig(tmp_path, "mine", 9),
        resume=False,
    )
    with keep_record(recorded) as checkpoint:
        with pytest.raises(ValueError, match="under way in another process: wait"):
            asked.accept()
        checkpoint.touch()
    config, message = asked.accept()
    assert "train.bags was" in message and "train.steps was 30, is 77 now; it keeps to" in message
    assert "topic was" not in message
    assert config == dataclasses.replace(
        recorded, output=OutputConfig(tmp_path, "mine", 2), resume=True
    )
    with pytest.raises(ValueError, match=r"of 'other' in .* \(unfinished: mine\)"):
        request(tmp_path, resume=True, name="other").accept()


def test_a_checkpoint_without_a_record_goes_on_with_the_parameters(tmp_path: Path) -> None:
    (tmp_path / ".mine.checkpoint").touch()
    with pytest.raises(ValueError, match=r"train\.bags"):
        request(tmp_path, resume=True, name="mine").accept()
    write(tmp_path, "/camera/keypoints")
    asked = request(tmp_path, resume=True, name="mine", bags=("keypoints",))
    assert asked.accept() == (asked.config, "") and asked.config.resume


def test_descriptions_of_parameters_stand_alone() -> None:
    fields = {
        field.name: opt.description
        for group in (TrainingOptions, Recipe, LayoutLossWeights, Limits, Curation)
        for field, _, opt in options(group)
    }
    assert all("bags_dir" in fields[name] for name in ("bags", "inputs"))  # where they must lie
    assert "train --camera free" in fields["spectral"]  # the service has no such parameter
    for jargon in ("label-free", "fans of", "spectral norm", "used with"):
        assert not [name for name, text in fields.items() if jargon in text]
