# SPDX-License-Identifier: Apache-2.0
"""Trainings are kept, go on where they stopped, and are told apart by all that shapes them."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import harness
from benchmarks.harness import Session, errors_by_column, run_program, with_proper
from benchmarks.paper import mirrored_frames, protocols, table1_cmu
from benchmarks.robustness import missing_keypoints
from benchmarks.table import Table, bars
from deep_nrsfm_ros.commands.evaluate import ALONE
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, Preset
from deep_nrsfm_ros.training import loop as training
from deep_nrsfm_ros.training.finish import finish
from deep_nrsfm_ros.training.steps import FROM_RANDOM
from deep_nrsfm_ros.training.trainer import Trainer

STEPS = 23  # snapshots do not divide it


class StoppedError(Exception):
    """Somebody pressed Ctrl-C."""


@pytest.fixture
def session(data: Path, tmp_path: Path) -> Session:
    return Session(data, tmp_path / "out", ("01",), (0,), STEPS, 1)


@pytest.fixture
def dataset(session: Session) -> Dataset:
    return session.mocap(["01"], "train")


@pytest.fixture
def preset(session: Session) -> Preset:
    preset = session.preset("default", 3)
    return preset._replace(architecture=dataclasses.replace(preset.architecture, widths=(8, 4)))


@pytest.fixture
def count_steps(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], list[int]]:
    """Return a function that counts steps from now on, and stops training after some of them."""

    advance = Trainer.advance

    def count(limit: int = 100) -> list[int]:
        steps: list[int] = []

        def counted(trainer: Trainer) -> None:
            if len(steps) == limit:
                raise StoppedError
            steps.append(trainer.step)
            advance(trainer)

        monkeypatch.setattr(Trainer, "advance", counted)
        return steps

    return count


def same(a: Model, b: Model) -> bool:
    pairs = zip(a.network.named_weights(), b.network.named_weights(), strict=True)
    return all(np.array_equal(x, y) for (_, x), (_, y) in pairs)


def test_reads_the_protocols_split(session: Session) -> None:
    train, held_out, both = (session.mocap(["01"], s) for s in ("train", "held-out", "all"))
    assert (len(train), len(held_out), len(both)) == (32, 8, 40)
    assert len(dataclasses.replace(session, stride=4).mocap(["01", "05"], "all")) == 20


def test_preset_has_seed_steps_and_options(session: Session) -> None:
    assert session.preset("paper", 7, added_noise=0.1).recipe == dataclasses.replace(
        PRESETS["paper"].recipe,
        seed=7,
        steps=STEPS,
        added_noise=0.1,
        start_share=0.0,
        limb_exchange=0.0,
    )
    whole = dataclasses.replace(session, steps=None)
    assert whole.preset("default", 0).recipe.steps == FROM_RANDOM
    scaled = dataclasses.replace(whole, error_scale=2.0)
    assert scaled.preset("default", 0).recipe.error_scale == 2
    untaught = dataclasses.replace(whole, few_frames=0)
    assert untaught.preset("default", 0).recipe.few_frames == 0
    exchanged = dataclasses.replace(whole, limb_exchange=1.0)
    assert exchanged.preset("default", 0).recipe.limb_exchange == 1


def test_snapshots_are_those_of_one_uninterrupted_training(
    session: Session, dataset: Dataset, preset: Preset
) -> None:
    models = session.snapshots("a title", dataset, preset)
    steps = [model.provenance["step"] for model in models]
    assert steps == [3, 5, 7, 10, 12, 14, 17, 19, 21, 23]
    seconds = [model.provenance["cpu_seconds"] for model in models]
    assert seconds == sorted(seconds) and seconds[-1] > 0
    whole = training.train(dataset.points, dataset.visible, preset)
    assert same(models[-1], finish(whole, "x", dataset.layout, dataset.source))
    assert not same(models[-2], models[-1])


def test_what_is_trained_is_not_trained_again(
    session: Session, dataset: Dataset, preset: Preset, count_steps: Callable[..., list[int]]
) -> None:
    steps = count_steps()
    first = session.trained("a title", dataset, preset)
    assert steps == [0, 1, 0, 1, 0, 1, *range(2, STEPS)]  # three seeds, of which one goes on
    again = session.trained("a title", dataset, preset)
    assert len(steps) == 6 + STEPS - 2 and same(first, again)
    assert first.provenance == again.provenance


def test_goes_on_where_it_stopped(
    session: Session,
    dataset: Dataset,
    preset: Preset,
    count_steps: Callable[..., list[int]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(harness, "CHECKPOINT_SECONDS", 0.0)
    whole = session.trained("a title", dataset, preset)
    elsewhere = dataclasses.replace(session, output=session.output / "elsewhere")
    count_steps(limit=11)
    with pytest.raises(StoppedError):
        elsewhere.trained("a title", dataset, preset)
    steps = count_steps()
    resumed = elsewhere.trained("a title", dataset, preset)
    assert steps[0] == 7 and same(whole, resumed)  # 3 x 2 to choose the seed, 5 to go on
    assert not list(elsewhere.output.glob("models/*/checkpoint"))


@pytest.mark.parametrize(
    "change",
    [
        lambda e, p: (e, p._replace(recipe=dataclasses.replace(p.recipe, seed=4))),
        lambda e, p: (e, p._replace(recipe=dataclasses.replace(p.recipe, added_noise=0.1))),
        lambda e, p: (
            e,
            p._replace(architecture=dataclasses.replace(p.architecture, widths=(9, 4))),
        ),
        lambda e, p: (e, p._replace(normaliser=dataclasses.replace(p.normaliser, scale="none"))),
        lambda e, p: (e[slice(1, None)], p),
        lambda e, p: (dataclasses.replace(e, points=2 * e.points), p),
        lambda e, p: (dataclasses.replace(e, visible=e.visible & (e.points[..., 0] > 0)), p),
    ],
    ids=["seed", "recipe", "architecture", "normaliser", "frames", "points", "visible"],
)
def test_another_training_is_another(
    session: Session,
    dataset: Dataset,
    preset: Preset,
    change: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(harness, "SNAPSHOTS", 1)
    session.trained("a title", dataset, preset)
    session.trained("a title", *change(dataset, preset))
    assert len(list(session.output.glob("models/a-title-*"))) == 2


def test_a_new_option_that_is_off_keeps_the_trainings_that_are_there(
    dataset: Dataset, preset: Preset
) -> None:
    longer = dataclasses.make_dataclass(
        "Recipe", [("new", float, 0.0)], bases=(type(preset.recipe),), frozen=True
    )
    fields = dataclasses.asdict(preset.recipe)
    found = {new: preset._replace(recipe=longer(**fields, new=new)) for new in (0.0, 0.5)}
    assert harness._hash(dataset, found[0.0]) == harness._hash(dataset, preset)
    assert harness._hash(dataset, found[0.5]) != harness._hash(dataset, preset)


def test_options_without_effect_keep_the_trainings_that_are_there(
    dataset: Dataset, preset: Preset, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = {
        scale: preset._replace(recipe=dataclasses.replace(preset.recipe, error_scale=scale))
        for scale in (1.0, 4.0)
    }
    digests = {scale: harness._hash(dataset, changed) for scale, changed in found.items()}
    assert digests[1.0] != digests[4.0]
    longer = dataclasses.make_dataclass(
        "Recipe", [("new", str, "as ever")], bases=(type(preset.recipe),), frozen=True
    )
    new = preset._replace(recipe=longer(**dataclasses.asdict(found[1.0].recipe)))
    assert harness._hash(dataset, new) != digests[1.0]
    monkeypatch.setitem(harness.WITHOUT_EFFECT, "new", "as ever")
    assert harness._hash(dataset, new) == digests[1.0]


def test_few_frames_enters_the_name_of_a_training_of_few_frames_only(
    dataset: Dataset, preset: Preset
) -> None:
    few, many = len(dataset) - 1, len(dataset)
    digests = {
        limit: harness._hash(
            dataset, preset._replace(recipe=dataclasses.replace(preset.recipe, few_frames=limit))
        )
        for limit in (0, few, many)
    }
    assert digests[0] == digests[few] != digests[many]


def test_across_gives_both_errors_of_every_test(
    session: Session, dataset: Dataset, preset: Preset
) -> None:
    model = session.trained("a title", dataset, preset)
    row = errors_by_column({"x": (model, dataset), "y": (model, dataset)}, ALONE)
    assert list(row) == with_proper(["x", "y"]) == ["x", "x proper", "y", "y proper"]
    assert 0 < row["x"] <= row["x proper"] and row["x"] == row["y"]


def test_command_prints_and_writes(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def benchmark(session: Session) -> Table:
        assert (session.subjects, session.seeds, session.steps) == (("05",), (4, 5), 6)
        table = Table("t", "T", ("a",), ("b",), {}, bars("b"))
        table.add(("x",), {"b": 1.0})
        return table

    options = ["--data", str(data), "--output", str(tmp_path), "--seeds", "4", "5", "--steps", "6"]
    run_program(benchmark, "about", ("05",), options)
    assert capsys.readouterr().out.strip() == (tmp_path / "t.md").read_text().strip()
    assert (tmp_path / "t.csv").exists() and (tmp_path / "t.png").exists()
    title = (tmp_path / "t.md").read_text().splitlines()[0]
    assert title == "## T; shortened: 6 steps a training (--steps)"


@pytest.mark.parametrize("program", [table1_cmu, protocols, mirrored_frames, missing_keypoints])
def test_help_lists_the_options_of_a_benchmark_alone(
    program: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        program.main(["--help"])
    listed = re.findall(r"^  --(recipes|protocols|trained) ", capsys.readouterr().out, re.MULTILINE)
    assert end.value.code == 0 and len(listed) == 1


def test_command_says_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def benchmark(session: Session) -> Table:
        raise AssertionError(session.mocap(session.subjects, "train"))

    with pytest.raises(SystemExit, match="2"):
        run_program(benchmark, "about", ("01",), ["--data", str(tmp_path)])
    assert "no trials 01_*.amc" in capsys.readouterr().err
