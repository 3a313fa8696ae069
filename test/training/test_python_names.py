# SPDX-License-Identifier: Apache-2.0
"""Sentences of a training name no option of the command line in Python."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deep_nrsfm_ros.data.curation import Curated, curate
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.hands import as_right_hands, mixed_sides
from deep_nrsfm_ros.data.sufficiency import assess_sufficiency
from deep_nrsfm_ros.data.virtual_hands import virtual_hands
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.lifting.observation import NAME_THE_LAYOUT
from deep_nrsfm_ros.lifting.sanity import check
from deep_nrsfm_ros.model_files.model_file import Model, load_model
from deep_nrsfm_ros.training.judge import MIRRORED_AS_A_WHOLE, _advice, _guessed
from deep_nrsfm_ros.training.python_names import in_python


def people(f: int = 60, shown: int = 17) -> Dataset:
    """Return views of one shape from one side."""
    shape = np.random.default_rng(0).uniform(100, 400, (17, 2))
    points = shape + np.random.default_rng(1).normal(0, 5, (f, 17, 2))
    return Dataset(
        points.astype(np.float32), np.ones((f, 17), bool) & (np.arange(17) < shown), HUMAN17, ""
    )


def sentences(human: Model) -> list[str]:
    """Return all sentences that name options and that a training in Python may say."""
    marked = np.where(np.arange(17)[:, None] % 4 == 0, -1, people().points)
    fractions = people().points / 500
    ones = np.ones((60, 17))
    poor = dataclasses.replace(curate(people()), few_visible=60, inconsistent=50, total=100)
    assert isinstance(poor, Curated)
    nameless = dataclasses.replace(people(), layout=KeypointLayout("thing", HUMAN17.keypoints))
    scratch = dataclasses.replace(human, provenance={})
    rare = human.provenance | {"rarely_shown": ["nose"]}
    rare["recipe"] = rare.get("recipe", {}) | {"start_share": 0.5}
    rare["from"] = {"model": "human"}
    started = dataclasses.replace(human, provenance=rare)
    said = [str(each) for points in (marked, fractions) for each in check(points, ones)]
    said += [*poor.warnings, *assess_sufficiency(people()).warnings]
    said += [assess_sufficiency(people(shown=3)).refusal, NAME_THE_LAYOUT]
    said += [mixed_sides(virtual_hands(60)), MIRRORED_AS_A_WHOLE.format("mine")]
    said += [_advice(scratch, ""), _advice(started, "human"), _guessed(started)]
    for wrong in (lambda: curate(people(shown=2)), lambda: as_right_hands(nameless, "palms")):
        with pytest.raises(ValueError) as caught:  # noqa: PT011
            wrong()
        said.append(str(caught.value))
    return said


def test_sentences_in_python_name_no_option() -> None:
    said = sentences(load_model("human"))
    options = ("--", "train.", "FILE", "image_width", "_weight")
    named = [text for text in said if any(option in text for option in options)]
    assert len(named) >= 13
    assert not [text for text in map(in_python, said) if any(option in text for option in options)]


def test_other_sentences_stay_as_they_are() -> None:
    text = "54 frames are few; expect a model of those frames alone"
    assert in_python(text) == text
