# SPDX-License-Identifier: Apache-2.0
"""Where `evaluate` looks for models."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from benchmarks.data.walking_person import in_layout
from deep_nrsfm_ros.commands import evaluate, train
from deep_nrsfm_ros.commands.evaluate import arguments, find_models, main
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.model_files.model_file import ModelFileError, load_model, save_model
from test.commands.test_models import save


def test_models_are_found_where_trainings_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ROS_HOME", str(tmp_path / "ros"))
    default = arguments().parse_args(["mine", "--cmu", "cmu"]).models_dir
    config = train.parse(train.parser().parse_args(["--cmu", "cmu"]), print)
    assert config.output.folder == default == tmp_path / "ros" / "deep_nrsfm_ros" / "models"
    save(default / "mine.safetensors")
    save(tmp_path / "runs" / "elsewhere.safetensors")
    assert len(find_models(["mine", "human"], default)) == 2
    assert len(find_models(["elsewhere", "human"], Path("runs"))) == 2
    with pytest.raises(ModelFileError, match="mine"):
        find_models(["absent"], default)


def test_without_truth_it_says_where_the_other_figures_are(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as end:
        main(["mine"])
    said = capsys.readouterr().err
    assert end.value.code == 2 and "give --cmu or --pose2sim" in said
    assert "without labels" in said and "MODEL.html" in said and "`models`" in said


def test_options_that_choose_trials_of_cmu_mean_nothing_for_pose2sim(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for options in (["--stride", "1"], ["--split", "all"], ["--subjects", "01"]):
        with pytest.raises(SystemExit) as end:
            main(["human", "--pose2sim", "absent.whl", *options])
        assert end.value.code == 2
        assert f"{options[0]} has no effect on --pose2sim" in capsys.readouterr().err


def walker() -> Dataset:
    """Return a person who walks; the truth is what `human17` lifts."""
    points, confidence = in_layout(HUMAN17, 30)
    shapes = Lifter("human17")(points, confidence).shapes
    return Dataset(points, confidence > 0, HUMAN17, "a walker", shapes)


def test_a_model_that_is_mirrored_as_a_whole_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(evaluate, "read_split", lambda *_: walker())
    sound = load_model("human17")
    mirror = np.diag([1, 1, -1]).astype(np.float32)
    frame = (sound.object_frame @ mirror).astype(np.float32)
    save_model(tmp_path / "turned.safetensors", dataclasses.replace(sound, object_frame=frame))
    words = ["human17", str(tmp_path / "turned.safetensors"), "--cmu", str(tmp_path)]
    main(words)
    said = capsys.readouterr()
    assert "model 'turned' is mirrored as a whole" in said.err and "human17" not in said.err
    rows = [line.split("|")[3:-1] for line in said.out.splitlines() if "| network alone |" in line]
    assert rows[0] == rows[1]  # the figures alone do not tell it
