# SPDX-License-Identifier: Apache-2.0
"""Each table from end to end on a tiny database, and its own arithmetic on known cases."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from benchmarks import harness
from benchmarks.baselines import batches, pursuit
from benchmarks.baselines.methods import BASELINES, Baseline, block_matrix
from benchmarks.harness import LIFTING_LEGEND, Session
from benchmarks.paper import (
    ablation,
    coherence,
    mirrored_frames,
    protocols,
    table1_cmu,
    table3_unseen,
)
from benchmarks.robustness import missing_keypoints, noise
from benchmarks.table import Table
from deep_nrsfm_ros.commands.evaluate import ALONE, LIFTING
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.nrsfm.geometry import centre
from deep_nrsfm_ros.nrsfm.recipe import PRESETS

LONE = ("--subjects", "01", "--seeds", "0", "1", "--steps", "3")
RIGID, SIMPLE = "rigid factorisation (Tomasi-Kanade)", "Simple (Dai et al.)"
ALL_TABLES = [
    table1_cmu,
    protocols,
    mirrored_frames,
    ablation,
    table3_unseen,
    noise,
    missing_keypoints,
    coherence,
]


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder for all tables: what one has trained, the next finds."""
    return tmp_path_factory.mktemp("output")


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let everything that takes long take less."""
    for name, preset in PRESETS.items():
        small = dataclasses.replace(preset.architecture, widths=(8, 4))
        monkeypatch.setitem(PRESETS, name, preset._replace(architecture=small))
    rigid = BASELINES[RIGID]
    for name in list(BASELINES):  # their order depends on what other tests have put back
        monkeypatch.delitem(BASELINES, name)
    monkeypatch.setitem(BASELINES, RIGID, rigid)
    monkeypatch.setitem(BASELINES, SIMPLE, Baseline(block_matrix, ({"K": 2},)))
    monkeypatch.setattr(harness, "SNAPSHOTS", 2)
    monkeypatch.setattr(table3_unseen, "TRAINED_ON", {"86": ("86",), "union": ("01", "86")})
    monkeypatch.setattr(table3_unseen, "TESTED_ON", ("14",))
    monkeypatch.setattr(table3_unseen, "DICTIONARIES", ((3, 0.1), (3, 1.0)))
    monkeypatch.setattr(table3_unseen, "PURSUIT_FRAMES", 1)
    monkeypatch.setattr(pursuit, "MAX_ATOMS", 1)
    monkeypatch.setattr(table3_unseen, "POSE_STRIDE", 1)


@pytest.fixture
def session(data: Path, tmp_path: Path) -> Session:
    return Session(data, tmp_path / "out", ("01",), (0,), 3, 1)


@pytest.fixture
def dataset(session: Session) -> Dataset:
    return session.mocap(["01"], "train")


def known(dataset: Dataset) -> dict[bytes, Any]:
    """Return the true shape of each frame's points."""
    assert dataset.shapes is not None
    frames = zip(dataset.points, dataset.shapes, strict=True)
    return {points.tobytes(): shape for points, shape in frames}


def rows(output: Path, name: str) -> list[dict[str, str]]:
    return list(csv.DictReader((output / f"{name}.csv").open()))


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("module", ALL_TABLES, ids=lambda module: module.__name__)
def test_runs_end_to_end(
    module: ModuleType, data: Path, output: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parts = ["--subjects", "01", "15-joints"] if module is table3_unseen else []
    module.main(["--data", str(data), "--output", str(output), *LONE, *parts])
    name = module.__name__.rsplit(".", 1)[-1]
    printed = capsys.readouterr().out
    assert printed.strip() == (output / f"{name}.md").read_text().strip()
    assert "O(3)" in printed and "proper" in printed  # the metric's conventions stand below
    assert (output / f"{name}.png").stat().st_size > 1000
    found = rows(output, name)
    assert {row["seed"] for row in found} >= {"0", "1"}
    for row in found:
        figures = [value for key, value in row.items() if "%" in key and value]
        assert all(np.isfinite(float(value)) for value in figures)


@pytest.mark.usefixtures("few")
def test_nrsfm_on_cmu_has_the_papers_figures_beside_ours(data: Path, output: Path) -> None:
    table1_cmu.main(["--data", str(data), "--output", str(output), *LONE])
    found = {row["method"]: row for row in rows(output, "table1_cmu")}
    assert list(found) == [
        *("paper: Deep NRSfM", "paper: Simple", "paper: Sparse", "paper: EM-SfM"),
        "paper's network, ours, network alone",
        *(f"default recipe, {x}" for x in LIFTING),
        *(RIGID, "Simple (Dai et al.), K = 2"),
    ]
    assert found["paper: Deep NRSfM"]["shape %"] == "10.74"
    assert found["paper: Deep NRSfM"]["point cm"] == "5.0638"
    assert found["paper: Deep NRSfM"]["proper %"] == ""
    ours = found["default recipe, back-projected"]
    assert float(ours["shape %"]) <= float(ours["proper %"])
    assert 0 <= float(ours["CPU min"]) < 1


@pytest.mark.usefixtures("few")
def test_recipes_and_protocols_can_be_chosen(data: Path, output: Path) -> None:
    options = ["--data", str(data), "--output", str(output), *LONE, "--baselines"]
    table1_cmu.main([*options, "--recipes", "paper"])
    ours = {row["method"] for row in rows(output, "table1_cmu") if row["seed"]}
    assert ours == {"paper's network, ours, network alone"}
    protocols.main([*options, "--protocols", "trial"])
    assert {row["protocol"] for row in rows(output, "protocols")} == {"a camera a trial, 120 Hz"}
    missing_keypoints.main([*options[:-1], "--trained", "masked"])
    assert {row["trained"] for row in rows(output, "missing_keypoints")} == {"masked"}


def test_papers_table_is_whole() -> None:
    assert table1_cmu.PAPER["Simple"]["127"] == {"shape %": 23.70, "point cm": 10.9473}
    assert all(len(subjects) == 10 for subjects in table1_cmu.PAPER.values())


def solved(session: Session, dataset: Dataset, baseline: Baseline) -> batches.Solved:
    """Return what `batches.solve` finds for a baseline of the test."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(BASELINES, "known", baseline)
        return batches.solve(session, "known", dataset)


def test_batches_are_compared_one_by_one(
    session: Session, dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benchmarks.baselines.methods.BATCH", 8)
    S = known(dataset)
    turns = iter([1, -1, 1, -1])

    def mirrors_every_other_batch(W: Any) -> Any:
        assert len(W) == 8
        shapes = np.stack([S[points.tobytes()] for points in W])
        return 3 * shapes * np.array([1, 1, next(turns)])

    whole = dataclasses.replace(session, batches=0)
    found = solved(whole, dataset, Baseline(mirrors_every_other_batch))
    assert found.frames == len(dataset) == 32
    errors = found.errors
    assert errors.shape == pytest.approx(0, abs=1e-5)
    assert errors.proper == pytest.approx(0, abs=1e-5) and errors.mirrored == 0
    assert errors.unscaled == pytest.approx(2, abs=1e-5)


def test_some_batches_are_a_sample_that_is_counted(
    session: Session, dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benchmarks.baselines.methods.BATCH", 8)
    sizes = []

    def flat(W: Any) -> Any:
        sizes.append(len(W))
        return np.concatenate([W, W[..., :1]], -1)

    assert solved(session, dataset, Baseline(flat)).figures["frames"] == 16
    assert sizes == [8, 8]


def test_the_best_of_equally_good_results_counts(session: Session, dataset: Dataset) -> None:
    S = known(dataset)

    def two(W: Any) -> Any:
        shapes = np.stack([S[points.tobytes()] for points in W])
        return np.stack([shapes[:, ::-1], shapes])

    assert solved(session, dataset, Baseline(two)).errors.shape < 1e-5


def test_frames_that_look_alike_have_no_proper_error(session: Session, dataset: Dataset) -> None:
    S = known(dataset)

    def by_neighbours(W: Any, frames: Any) -> Any:
        assert W.shape[0] == 1 and len(frames) == len(dataset)
        return S[W[0].tobytes()][None]

    found = solved(session, dataset, Baseline(by_neighbours, by_neighbours=True))
    assert found.figures["shape %"] < 1e-3 and "proper %" not in found.figures


def test_frames_that_look_alike_are_looked_for_among_other_frames(
    session: Session, dataset: Dataset
) -> None:
    S, others = known(dataset), session.mocap(["86"], "all")

    def by_neighbours(W: Any, frames: Any) -> Any:
        assert sorted(frames.sum((1, 2))) == sorted(others.points.sum((1, 2)))
        return S[W[0].tobytes()][None]

    baseline = Baseline(by_neighbours, by_neighbours=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(BASELINES, "of others", baseline)
        found = batches.solve(session, "of others", dataset, others)
    assert found.frames == len(dataset) and found.errors.shape < 1e-5


def test_time_of_all_baselines_stands_below_the_table(session: Session, dataset: Dataset) -> None:
    row = solved(session, dataset, Baseline(lambda W, K: W @ np.eye(2, 3), ({"K": 1}, {"K": 2})))
    assert row.search_seconds > 0
    minutes = (row.cpu_seconds + row.search_seconds) / 60
    assert row.figures["CPU min"] == pytest.approx(minutes)
    table = Table("t", "T", ("method",), ("CPU min", "ms"), {}, lambda table, figure: None)
    table.add(("network",), {"CPU min": 90.0})
    for i, spent in enumerate((1.5, 2.25)):
        table.add((f"baseline {i}",), {"CPU min": spent, "ms": 1.0})
    batches.complete_legend(table)
    assert "together: 3.8 CPU min" in table.markdown()


def test_a_legend_has_notes_of_the_rows_that_are_there() -> None:
    notes = {"shape %": "error", **LIFTING_LEGEND, **batches.LEGEND, "other": "kept"}
    table = Table("t", "T", ("method",), ("shape %",), notes, lambda table, figure: None)
    table.add(("paper: Simple",), {"shape %": 1.0})
    table.add(("default recipe, as shipped",), {"shape %": 1.0})
    batches.complete_legend(table)
    assert list(table.legend) == ["shape %", "as shipped", "other"]
    table.legend = notes
    table.add(("Simple, K = 5",), {"shape %": 1.0})
    batches.complete_legend(table)
    shown = {"Simple, EM-SfM, Sparse, SfC"} | ({"Simple"} & set(batches.LEGEND))
    assert set(table.legend) == {"shape %", "as shipped", "other"} | shown


def test_baselines_are_solved_once(
    session: Session, dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = batches.solve(session, "rigid factorisation (Tomasi-Kanade)", dataset)
    monkeypatch.setattr(batches, "_solve", None)
    assert batches.solve(session, "rigid factorisation (Tomasi-Kanade)", dataset) == first


def test_setting_is_the_one_of_lowest_error(session: Session, dataset: Dataset) -> None:
    S = known(dataset)

    def best_at_five(W: Any, K: int) -> Any:
        shapes = np.stack([S[points.tobytes()] for points in W])
        noise = np.random.default_rng(0).standard_normal(shapes.shape)
        return shapes + 0.01 * abs(K - 5) * noise

    baseline = Baseline(best_at_five, tuple({"K": K} for K in range(2, 9)))
    found = solved(session, dataset, baseline)
    assert found.setting == {"K": 5} and found.errors.shape < 1e-5
    assert found.label == "known, K = 5"


def test_noise_has_the_ratio_asked_for(dataset: Dataset) -> None:
    added = noise.add_noise(dataset, 0.2).points - dataset.points
    ratio = np.linalg.norm(added, axis=(1, 2)) / np.linalg.norm(dataset.points, axis=(1, 2))
    np.testing.assert_allclose(ratio, 0.2, rtol=1e-5)
    assert noise.add_noise(dataset, 0.0) is dataset


@pytest.mark.parametrize(("what", "count"), [("0", 0), ("1", 1), ("9", 9), ("arm", 6), ("leg", 4)])
def test_hides_points(dataset: Dataset, what: str, count: int) -> None:
    test = missing_keypoints.hide(dataset, what)
    assert ((~test.visible).sum(1) == count).all()
    assert (test.points[~test.visible] == 0).all()
    np.testing.assert_array_equal(test.points[test.visible], dataset.points[test.visible])
    if what in missing_keypoints.LIMBS:
        sides = {tuple(np.flatnonzero(~frame)) for frame in test.visible}
        names = {"".join(dataset.layout.keypoints[i][0] for i in side) for side in sides}
        assert names == {"l" * count, "r" * count}


def test_similarity_forgives_the_scale_only(session: Session, dataset: Dataset) -> None:
    model = session.trained("a title", dataset, session.preset("default", 0))
    found = table3_unseen.errors(model, dataset, ALONE)
    assert 0 < found["similarity %"] < found["proper %"] + 1e-6 or found["mirrored %"] > 0
    assert found["relative %"] < found["similarity %"] + 1e-6


def test_readings_of_table_3_are_of_one_alignment() -> None:
    rng = np.random.default_rng(0)
    truth = centre(rng.standard_normal((5, 15, 3)))
    mirrored = 7 * truth * np.array([1, 1, -1]) + 3
    found = table3_unseen.errors_of_shapes(mirrored, truth)
    assert found["distance"] < 1e-6 and found["relative %"] < 1e-4
    moved = truth.copy()
    moved[:, 0, 0] += 0.01  # so little that alignment hardly follows
    found = table3_unseen.errors_of_shapes(moved, truth)
    size = np.linalg.norm(truth, axis=(1, 2))
    assert found["relative %"] == pytest.approx(100 * (0.01 / size).mean(), rel=0.2)
    ratio = found["relative %"] / 100 / found["distance"]
    assert 0 < ratio * truth.std(1).mean() ** -1 < 2


def test_turntable_cameras_see_the_vertical_as_it_is() -> None:
    M = table3_unseen.turntable_cameras(20, np.random.default_rng(0))
    np.testing.assert_allclose(
        M.swapaxes(1, 2) @ M, np.broadcast_to(np.eye(2), (20, 2, 2)), atol=1e-6
    )
    np.testing.assert_array_equal(np.array([0, 1, 0]) @ M, np.tile([0, 1], (20, 1)))
    assert np.ptp(M[:, 0, 0]) > 1


def test_one_camera_sees_all_frames_of_a_trial(session: Session, dataset: Dataset) -> None:
    trial = dataclasses.replace(session, one_camera=True).mocap(["01"], "train")
    assert trial.shapes is not None and dataset.shapes is not None
    np.testing.assert_array_equal(trial.shapes, dataset.shapes)
    cameras = [np.linalg.pinv(S) @ W for S, W in zip(trial.shapes, trial.points, strict=True)]
    np.testing.assert_allclose(np.ptp(cameras[:8], axis=0), 0, atol=1e-5)  # 8 frames a trial
    assert np.abs(cameras[7] - cameras[8]).max() > 0.1


def test_correlation_has_its_sign_and_choice_its_error() -> None:
    table = Table("t", "", ("a", "b", "error"), (*coherence.GUIDES, *coherence.CHOSEN), {}, print)
    points = [
        coherence.Point(
            {"coherence": 1 - x, "combined": x, "reprojection_error": x, "cycle_error": x},
            {"shape %": 10 * x + 1, "proper %": 10 * x + 2},
        )
        for x in (0.1, 0.5, 0.3, 0.9)
    ]
    coherence._correlate(table, ("01", "along"), points, 0)
    shape, proper = (row.figures for row in table.rows)
    assert shape["coherence"] == pytest.approx(-1) and shape["combined"] == pytest.approx(1)
    assert (shape["chosen by coherence"], shape["chosen by combined"]) == (10.0, 2.0)
    assert (shape["best"], proper["best"]) == (2.0, 3.0)


@pytest.mark.parametrize("name", list(ablation.VARIANTS))
def test_a_variant_is_the_default_but_for_what_it_changes(
    few: None, session: Session, dataset: Dataset, name: str
) -> None:
    model = ablation.trained(session, "01", dataset, name, 0)
    architecture, recipe = ablation.VARIANTS[name]
    # A repair of mirrored frames would hide what the changed part brings.
    default = session.preset("default", 0, mirror_repair="off")
    assert model.network.architecture == dataclasses.replace(default.architecture, **architecture)
    expected = dataclasses.asdict(dataclasses.replace(default.recipe, **recipe))
    assert model.provenance["recipe"] == expected
