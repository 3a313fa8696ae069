# SPDX-License-Identifier: Apache-2.0
"""The benchmarks of speed: their tables' form and arithmetic; what they time is not looked at."""

from __future__ import annotations

import csv
import dataclasses
import os
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.speed import (
    bag_reading,
    forward_pass,
    latency,
    latency_breakdown,
    round_trip,
    shared_reading,
    time_to_error,
    training_scale,
    training_speed,
)
from benchmarks.speed import (
    timing as speed,
)
from benchmarks.table import Table
from deep_nrsfm_ros.commands.train import parser
from deep_nrsfm_ros.data.bags import frames, write_bag
from deep_nrsfm_ros.layouts.presets import CMU31
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.network import initialise
from deep_nrsfm_ros.nrsfm.recipe import PRESETS
from deep_nrsfm_ros.training.config import TrainingConfig
from deep_nrsfm_ros.training.preparation import read_data
from deep_nrsfm_ros.training.reporter import Reporter


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let networks be small."""
    for name, preset in PRESETS.items():
        small = dataclasses.replace(preset.architecture, widths=(8, 4))
        monkeypatch.setitem(PRESETS, name, preset._replace(architecture=small))


def rows(module: ModuleType, output: Path, *speed_parser: str) -> list[dict[str, str]]:
    """Run a benchmark quickly and return its first table."""
    module.main(["--quick", "--output", str(output), *speed_parser])
    name = module.__name__.rsplit(".", 1)[-1]
    return list(csv.DictReader((output / f"{name}.csv").open()))


def test_contenders_take_turns() -> None:
    order: list[str] = []
    calls = {name: lambda name=name: order.append(name) for name in "AB"}
    took = speed.interleaved(calls, rounds=3, seconds=0.0, warm_up=2)
    assert "".join(order) == "AABB" + "AB" * 3
    assert [len(times) for times in took.values()] == [3, 3]


def test_a_table_names_the_machine(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = Table("t", "A title", ("a",), ("b",), {}, lambda table, figure: None)
    table.add(("x",), {"b": 1.0})
    speed.print_and_write([table], tmp_path)
    assert f"## A title ({speed.machine()})" in capsys.readouterr().out
    assert "core" in speed.machine()


def test_forward_compares_with_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    architecture, normaliser, _ = PRESETS["default"]
    small = dataclasses.replace(architecture, widths=(8, 4))
    network = initialise(small, len(CMU31), np.random.default_rng(0))
    model = Model("m", network, CMU31, normaliser, np.eye(3, dtype=np.float32))
    monkeypatch.setattr(forward_pass, "models", lambda: {"default": model})
    monkeypatch.setattr(forward_pass, "BATCHES", (2,))
    found = {row["by"]: row for row in rows(forward_pass, tmp_path)}
    assert {forward_pass.OURS, "torch eager", "torch.jit", "NumPy", "Lifter"} <= found.keys()
    assert any(forward_pass.ONNX in by for by in found)  # measured, or said not to be installed
    ours = float(found[forward_pass.OURS]["p50 us"])
    for row in found.values():
        if row["ratio"]:
            assert float(row["ratio"]) == pytest.approx(float(row["p50 us"]) / ours)


def test_all_passes_compute_the_same() -> None:
    network = initialise(PRESETS["default"].architecture, 9, np.random.default_rng(0))
    W = np.random.default_rng(1).standard_normal((3, 9, 2), dtype=np.float32)
    with torch.no_grad():
        results: dict[str, Any] = {n: call() for n, call in forward_pass.passes(network, W).items()}
    for S, M in results.values():
        np.testing.assert_allclose(np.asarray(S), results["NumPy"][0], rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(np.asarray(M), results["NumPy"][1], rtol=1e-3, atol=1e-4)


@given(st.floats(150, 5000), st.integers(8, 14))
def test_the_highest_rate_is_found(capacity: float, trials: int) -> None:
    search = latency.Search(100.0)
    for _ in range(trials):
        search.update(kept=search.rate <= capacity)
    assert capacity / 2 < search.best <= capacity


def test_a_node_that_keeps_no_rate_has_none() -> None:
    search = latency.Search(100.0)
    for _ in range(4):
        search.update(kept=False)
    assert np.isnan(search.best) and 0 < search.rate < 100


def test_the_ratio_is_of_the_lifter_to_the_relay() -> None:
    table = Table("t", "", ("Hz", "node"), ("p50 ms",), {}, lambda table, figure: None)
    latency.add_with_ratio(table, ("30",), {"relay": {"p50 ms": 2.0}, "lifter": {"p50 ms": 3.0}})
    assert table.rows[-1].labels == ("30", latency.RATIO)
    assert table.rows[-1].figures == {"p50 ms": 1.5}


def test_the_relay_answers_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "0")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    raw = round_trip.serialised_keypoints(2, 31)
    with round_trip.running_node("relay", raw, tmp_path, round_trip.LOSSLESS) as relay:
        played = relay.client.play(raw, rate=50.0, seconds=0.2, grace=60.0)
        assert played.sent == len(played.latencies) == 10
        assert (played.latencies > 0).all() and relay.start > 0 and relay.memory() > 1


def test_time_is_counted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])
    stopwatch = latency_breakdown.Stopwatch()

    def spend(seconds: float) -> None:
        clock[0] += seconds

    inner = stopwatch.wrapped("inner", spend)
    with stopwatch.timed("outer"):
        spend(1)
        inner(2)
        inner(4)
    assert stopwatch.seconds == {"outer": 1, "inner": 6}


def test_every_step_has_its_functions() -> None:
    functions = [function for step in latency_breakdown.STEPS.values() for function in step]
    assert all(callable(getattr(owner, name)) for owner, name in functions)


def test_shares_are_of_the_sum() -> None:
    times = {
        "read": 30.0,
        "network": 90.0,
        latency_breakdown.SUM: 120.0,
        latency_breakdown.TOTAL: 100,
    }
    values = latency_breakdown.tabulate({1: times}).values()
    assert values[("read",)] == {"1 object": [30], "1 object %": [25]}
    assert values[(latency_breakdown.SUM_TO_TOTAL,)] == {"1 object": [1.2]}


@pytest.mark.usefixtures("few")
def test_training_speed_compares_with_plain_torch(tmp_path: Path) -> None:
    found = rows(training_speed, tmp_path)
    assert len(found) == 2 * 2 * len(training_speed.CASES)
    for plain, ours in zip(found[::2], found[1::2], strict=True):
        assert (plain["by"], ours["by"]) == (training_speed.PLAIN, training_speed.OURS)
        ratio = float(ours["samples/s"]) / float(plain["samples/s"])
        assert float(ours["ratio"]) == pytest.approx(ratio) and float(plain["ratio"]) == 1


def test_exponents_are_those_of_the_times() -> None:
    measured = [
        {"frames": f, "curation s": f**0.5, "preparation s": 1e-9 * f**2, "epoch s": 3e-5 * f}
        for f in (1e4, 1e5, 1e6)
    ]
    values = training_scale.table(measured).values()[(training_scale.EXPONENT,)]
    assert values["epoch s"] == [pytest.approx(1)]
    assert values["preparation s"] == [pytest.approx(2)]
    assert values["curation s"] == [pytest.approx(0.5)]


@pytest.mark.usefixtures("few")
def test_an_epoch_is_measured() -> None:
    found = training_scale.measure(300)
    assert found["dataset MB"] == pytest.approx(300 * 31 * 9 / 2**20)
    assert found["epoch s"] > 0 and found["preparation s"] > 0 and found["curation s"] > 0


def test_bag_reading_gives_the_share_of_rosbags(tmp_path: Path) -> None:
    found = rows(bag_reading, tmp_path)
    assert [row["by"] for row in found] == [bag_reading.BARE, bag_reading.OURS] * 2
    for bare, ours in zip(found[::2], found[1::2], strict=True):
        share = float(ours["messages/s"]) / float(bare["messages/s"])
        assert float(ours["share"]) == pytest.approx(share)


def test_the_large_training_reads_the_bag_that_is_made_for_it(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    write_bag(bag, shared_reading.TOPIC, shared_reading.repeated_frames(60, 20))
    words = shared_reading.large_training(bag, 60, tmp_path)
    config = TrainingConfig.from_arguments(parser().parse_args(words))
    dataset = read_data(config, Reporter(True, lambda: False)).dataset
    assert dataset.visible.all() and dataset.points.shape == (60, 17, 2)


def test_both_readers_read_every_message(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(1, 9, (7, 31, 2))
    write_bag(tmp_path / "bag", bag_reading.TOPIC, frames(points, np.ones((7, 31))))
    assert [read() for read in bag_reading.readers(tmp_path / "bag").values()] == [7, 7]


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("target", ["1000", "0"])
def test_time_to_error_compares_only_what_was_reached(
    data: Path, tmp_path: Path, target: str
) -> None:
    found = rows(time_to_error, tmp_path, "--data", str(data), "--stride", "1", "--error", target)
    by = {row["recipe"]: row for row in found}
    assert by.keys() == time_to_error.CONTENDERS.keys()
    for row in found:
        assert row["reached"] == ("yes" if target == "1000" else "no")
        ratio = float(by["paper"]["wall s"]) / float(row["wall s"])
        expected = pytest.approx(ratio) if target == "1000" else None
        assert (float(row["paper / this"]) if row["paper / this"] else None) == expected


def test_domains_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    assert speed.random_domain() != speed.random_domain()


def test_variables_are_as_they_were_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("THERE", "before")
    monkeypatch.delenv("NEW", raising=False)

    def fail() -> None:
        with speed.environment(THERE=None, NEW="now"):
            assert "THERE" not in os.environ and os.environ["NEW"] == "now"
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert os.environ["THERE"] == "before" and "NEW" not in os.environ
