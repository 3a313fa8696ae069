# SPDX-License-Identifier: Apache-2.0
"""One configuration for the command line, the service and the record on disk."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros.commands.train import parser
from deep_nrsfm_ros.data.curation import KEEP_ALL, Curation
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.model_files.matching_model import matching_model
from deep_nrsfm_ros.model_files.model_file import Model, save_model
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, LayoutLossWeights, Recipe
from deep_nrsfm_ros.training.config import (
    COMMAND_LINE,
    PARAMETERS,
    DataConfig,
    OutputConfig,
    TrainingConfig,
    differences,
)
from deep_nrsfm_ros.training.limits import WHOLE, Limits


def parsed(*words: str, base: TrainingConfig | None = None) -> TrainingConfig:
    return TrainingConfig.from_arguments(parser().parse_args(words), base)


def other(value: Any) -> Any:
    """Return another value of the same type."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, (int, float)):
        return value + 1
    if isinstance(value, tuple):
        return (*value, value[0] if value else Path("/other"))
    return Path("/other") if value is None or isinstance(value, Path) else f"{value}other"


def changed(config: Any) -> Any:
    """Return the configuration with another value of each option of each part."""
    values = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if field.name == "missing_value":  # a number or None
            values[field.name] = -1.0
            continue
        values[field.name] = changed(value) if dataclasses.is_dataclass(value) else other(value)
        if opt := field.metadata.get("option"):
            if opt.choices:
                values[field.name] = next(each for each in opt.choices if each != value)
            elif opt.high is not None and not isinstance(value, tuple) and value + 1 > opt.high:
                values[field.name] = (value + opt.low) / 2 if value > opt.low else opt.high / 2
    return type(config)(**values)


def test_every_option_comes_back_from_json() -> None:
    config = changed(TrainingConfig())
    assert TrainingConfig.from_json(config.to_json()) == config.whole()
    assert config.data != TrainingConfig().data and config.resume


def test_a_training_of_people_starts_from_the_model_of_people_unless_told_otherwise() -> None:
    bag, human = ("--bag", "a"), str(matching_model("human25"))
    assert Path(human).stem == "human"
    assert (parsed(*bag).start, parsed(*bag).rival) == (human, human)
    assert parsed(*bag, "--object", "coco17").start == human
    assert Path(parsed(*bag, "--object", "human17").start).stem == "human17"
    for words in (("--from", "none"), ("--widths", "8", "4"), ("--preset", "paper")):
        config = parsed(*bag, *words)
        assert (config.start, config.rival) == ("", human)
    for words in (("--object", "ap10k17"), ("--object", "numbered")):
        config = parsed(*bag, *words)
        assert (config.start, config.rival) == ("", "")
    assert parsed("--cmu", "c", "--object", "human17").start == ""


def test_motion_capture_starts_from_random_weights_and_the_help_says_so() -> None:
    config = TrainingConfig.from_arguments(parser().parse_args(["--cmu", "FOLDER"]))
    assert not config.start and not config.rival
    assert "if there is one; with --cmu none)" in " ".join(parser().format_help().split())


def test_the_command_line_reaches_every_option_of_the_parts() -> None:
    config = parsed(
        *("--bag", "a", "--bag", "b", "--topic", "/k", "--keypoint-layout", "coco17"),
        *("--min-confidence", "0.25", "--mapping", "m.yaml", "--image-width", "640"),
        *("--missing-value", "-1", "--min-score", "0.5", "--category", "person"),
        *("--image-height", "480", "--stride", "2", "--camera-seed", "3", "--all-trials"),
        *("--subjects", "02", "03", "--object", "human17", "--name", "mine", "--output", "out"),
        *("--threads", "3", "--resume", "--steps", "7", "--widths", "8", "4", "--scale", "none"),
        *("--bone-length-weight", "1.5", "--minutes", "2.5", "--no-keep-best"),
        *("--min-visible", "5"),
    )
    assert config == TrainingConfig(
        data=DataConfig(
            bags=(Path("a"), Path("b")),
            topic="/k",
            keypoint_layout="coco17",
            min_confidence=0.25,
            mapping="m.yaml",
            missing_value=-1.0,
            min_score=0.5,
            category="person",
            image_width=640,
            image_height=480,
            subjects=("02", "03"),
            all_trials=True,
            stride=2,
            camera_seed=3,
        ),
        object="human17",
        architecture=Architecture(widths=(8, 4)),
        normaliser=Normaliser(scale="none"),
        recipe=Recipe(steps=7),
        layout_loss=LayoutLossWeights(bone_length_weight=1.5),
        curation=Curation(min_visible=5),
        limits=Limits(minutes=2.5, keep_best=False),
        output=OutputConfig(Path("out"), "mine", 3),
        rival=str(matching_model("human17")),
        resume=True,
    )
    assert config.data.image_size == (640, 480) and DataConfig(image_width=3).image_size is None


def test_each_option_has_one_place() -> None:
    """Options are set by the field's name alone, so no two parts may share one."""
    config, names = TrainingConfig(), Counter[str]()
    for field in dataclasses.fields(config):
        part = getattr(config, field.name)
        inside = dataclasses.fields(part) if dataclasses.is_dataclass(part) else [field]
        names.update(item.name for item in inside)
    assert set(names.values()) == {1}


def test_defaults_depend_on_the_data_and_the_preset() -> None:
    assert parsed() == TrainingConfig()
    mocap = parsed("--cmu", "folder", "--min-change", "0.5")
    assert mocap.limits == WHOLE
    assert mocap.curation == dataclasses.replace(KEEP_ALL, min_change=0.5)
    paper = parsed("--preset", "paper", "--steps", "5")
    assert paper.architecture == PRESETS["paper"].architecture
    assert paper.recipe == dataclasses.replace(PRESETS["paper"].recipe, steps=5)
    assert paper.preset.normaliser == PRESETS["paper"].normaliser


def test_what_is_given_replaces_what_was_recorded_and_nothing_else() -> None:
    base = changed(TrainingConfig())
    assert parsed(base=base) == base
    config = parsed("--steps", "5", "--min-visible", "9", base=base)
    assert config.with_options({"steps": base.recipe.steps, "min_visible": 5}) == base
    assert base == changed(TrainingConfig())


def test_a_start_brings_its_architecture(tmp_path: Path) -> None:
    layout, architecture = KeypointLayout("figure", tuple("abcde")), Architecture(widths=(4,))
    network = initialise(architecture, 5, np.random.default_rng(0))
    path = tmp_path / "old.safetensors"
    frame = np.eye(3, dtype=np.float32)
    save_model(path, Model("old", network, layout, Normaliser("none"), frame))
    config = parsed("--from", "old", "--output", str(tmp_path), "--added-noise", "0.5")
    assert (config.start, config.architecture) == (str(path), architecture)
    assert (config.normaliser.scale, config.recipe.added_noise) == ("none", 0.5)


def test_paths_become_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dog.yaml").touch()
    (tmp_path / "human17").touch()
    config = parsed("--bag", "a", "--bag", "/b", "--object", "dog.yaml", "--output", "models")
    config = dataclasses.replace(config, start="human17").whole()
    assert config.data.bags == (tmp_path / "a", Path("/b"))
    assert (config.object, config.start) == (str(tmp_path / "dog.yaml"), "human17")
    assert config.output.folder == tmp_path / "models"
    assert config.data.cmu is None and config.data.mapping == ""


def test_differences_are_named_as_the_caller_names_options() -> None:
    old = parsed("--bag", "/a", "--steps", "5", "--name", "mine")
    new = parsed("--bag", "/a", "--bag", "/b", "--steps", "7", "--topic", "/k", "--name", "other")
    assert differences(old, new, COMMAND_LINE) == [
        "--bag was /a, is /a /b now",
        "--topic was empty, is /k now",
        "--steps was 5, is 7 now",
    ]
    assert differences(old, new, PARAMETERS)[0] == "train.bags was /a, is /a /b now"
    assert differences(old, old, PARAMETERS) == []


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[1]", "the configuration is "),
        ("{", "Expecting"),
        ("[" * 100_000, "nested too deeply"),
        ('{"recipe": {"steps": "many"}}', "recipe.steps is 'many'"),
        ('{"recipe": {"steps": true}}', "recipe.steps is True"),
        ('{"recipe": {"stops": 3}}', "recipe.stops is no option"),
        ('{"architecture": {"widths": []}}', "widths is empty"),
        ('{"data": {"bags": [1]}}', "data.bags is 1"),
        ('{"data": {"bags": "a"}}', "data.bags is 'a'"),
    ],
)
def test_what_is_no_configuration_is_refused(text: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint.replace("[", r"\[")):
        TrainingConfig.from_json(text)


def test_fields_that_are_left_out_have_defaults() -> None:
    config = TrainingConfig.from_json('{"recipe": {"learning_rate": 1}, "data": {"cmu": "/c"}}')
    assert config.recipe == Recipe(learning_rate=1.0)
    assert config.data == DataConfig(cmu=Path("/c"))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.sampled_from(["data", "recipe"]), inner),
    max_leaves=8,
)


@settings(deadline=None)
@given(st.dictionaries(st.sampled_from([f.name for f in dataclasses.fields(TrainingConfig)]), JSON))
def test_any_json_is_a_configuration_or_refused(values: dict[str, Any]) -> None:
    try:
        config = TrainingConfig.from_json(json.dumps(values))
    except ValueError as refusal:
        assert str(refusal)
    else:
        assert TrainingConfig.from_json(config.to_json()) == config.whole()
