# SPDX-License-Identifier: Apache-2.0
"""Sentences of a training name no option of the command line in Python, nor in the node."""

from __future__ import annotations

import ast
import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from deep_nrsfm_ros.data.curation import Curated, curate
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.hands import as_right_hands, mixed_sides
from deep_nrsfm_ros.data.sufficiency import assess_sufficiency, how_to_learn_depth
from deep_nrsfm_ros.data.virtual_hands import virtual_hands
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.lifting.sanity import check
from deep_nrsfm_ros.model_files.model_file import Model, load_model
from deep_nrsfm_ros.training.few_frames import _beginning
from deep_nrsfm_ros.training.judge import _advice, _guessed, _mirrored_as_a_whole
from deep_nrsfm_ros.training.mirror import warning
from deep_nrsfm_ros.wording import in_node, in_python, wording
from test.test_rooms import PACKAGE, imports

OPTION = re.compile(r"--[a-z]+(?:-[a-z]+)*|\btrain\.[a-z_*]+|\bFILE\b|image_width")
FILES_ALONE = "training/layout_choice.py"
"""Says nothing to Python's `train`, and imports the readers of files and bags."""
NOT_SAID = {
    ("lifting/observation.py", "--keypoint-layout"): "of a message",
    ("lifting/options.py", "image_width"): "of the node",
    ("messages/field_mapping.py", "image_width"): "of a message",
    ("model_files/matching_model.py", "--model"): "of what is lifted",
}
"""Options that files of Python's `train` name by the words of the programs alone, and why."""


def people(f: int = 60, shown: int = 17) -> Dataset:
    """Return views of one shape from one side."""
    shape = np.random.default_rng(0).uniform(100, 400, (17, 2))
    points = shape + np.random.default_rng(1).normal(0, 5, (f, 17, 2))
    return Dataset(
        points.astype(np.float32), np.ones((f, 17), bool) & (np.arange(17) < shown), HUMAN17, ""
    )


def sentences(human: Model) -> list[str]:
    """Return sentences that a training may say, with all that name options."""
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
    said += [assess_sufficiency(people(shown=3)).refusal, how_to_learn_depth()]
    said += [mixed_sides(virtual_hands(60)), _mirrored_as_a_whole("mine")]
    said += [_advice(scratch, ""), _advice(started, "human"), _guessed(started)]
    for wrong in (lambda: curate(people(shown=2)), lambda: as_right_hands(nameless, "palms")):
        with pytest.raises(ValueError) as caught:  # noqa: PT011
            wrong()
        said.append(str(caught.value))
    return said


def named_outside_wording(path: Path) -> set[str]:
    """Return the options in strings that are no docstring, help text, or words of programs."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    calls = [node for node in nodes if isinstance(node, ast.Call)]
    said = [call for call in calls if ast.unparse(call.func) in ("option", "wording")]
    words = [part for call in said for part in call.args]
    words += [each.value for call in said for each in call.keywords if each.arg == "node"]
    left_out = {id(inner) for part in words for inner in ast.walk(part)}
    left_out |= {id(node.value) for node in nodes if isinstance(node, ast.Expr)}  # docstrings
    texts = [node for node in nodes if isinstance(node, ast.Constant) and id(node) not in left_out]
    return {option for text in texts for option in OPTION.findall(str(text.value))}


def files_of_train() -> Iterator[Path]:
    """Yield the files of the package that Python's `train` imports, also through others."""
    seen, waiting = {PACKAGE / FILES_ALONE}, [PACKAGE / "training/from_arrays.py"]
    while waiting:
        path = waiting.pop()
        if path in seen or not path.is_file():
            continue
        seen.add(path)
        yield path
        for module in imports(path):  # or a name in a module
            place = PACKAGE.parent / module.replace(".", "/")
            waiting += [place.with_suffix(".py"), place.parent.with_suffix(".py")]


def test_wording_names_each_option_that_python_may_read() -> None:
    named = {
        (path.relative_to(PACKAGE).as_posix(), option)
        for path in files_of_train()
        for option in named_outside_wording(path)
    }
    assert named == set(NOT_SAID)


def test_words_are_chosen_when_a_sentence_is_made_and_not_at_the_import() -> None:
    for path in PACKAGE.rglob("*.py"):
        nodes = list(ast.walk(ast.parse(path.read_text())))
        functions = [node for node in nodes if isinstance(node, ast.FunctionDef | ast.Lambda)]
        late = {id(inner) for function in functions for inner in ast.walk(function)}
        said = [n for n in nodes if isinstance(n, ast.Call) and ast.unparse(n.func) == "wording"]
        assert not [f"{path}:{node.lineno}" for node in said if id(node) not in late]


def test_sentences_in_python_name_no_option() -> None:
    human = load_model("human")
    assert sum(bool(OPTION.search(text)) for text in sentences(human)) >= 13
    with in_python():
        assert not [text for text in sentences(human) if OPTION.search(text)]


def test_sentences_in_the_node_name_parameters_alone() -> None:
    human = load_model("human")

    def said() -> list[str]:
        hurried = dataclasses.replace(human, provenance={"factorisation_needs_minutes": 2.5})
        more = [_advice(hurried, ""), _beginning(60, 75.0, 1.0), warning(0.3)]
        return [*sentences(human), *more, curate(people()).summary]

    options = re.compile(r"(?<!-)--[a-z]")
    files_alone = "--missing-value"  # of files, for which the node has no parameter
    with in_node():
        assert not [s for s in said() if options.search(s) and files_alone not in s]
        assert sum("train." in s for s in said()) >= 10
    assert sum(bool(options.search(s)) for s in said()) >= 13


def test_after_python_words_are_those_of_the_programs_again() -> None:
    with pytest.raises(ValueError, match="start"), in_python():
        raise ValueError(wording("--from", python="start"))
    assert wording("--from", python="start") == "--from"
