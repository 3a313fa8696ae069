# SPDX-License-Identifier: Apache-2.0
"""From bags to tables: real trainings, a few steps each, of little data."""

from __future__ import annotations

import csv
import gzip
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.data import synthetic_excavator as excavator
from benchmarks.real import train_from_bags
from deep_nrsfm_ros.data.bags import read_bags
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.layouts.presets import BODY25, HUMAN17
from test.fixtures.forked_python import TRAINING, forked_programs


@pytest.fixture(autouse=True)
def _environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        monkeypatch.setenv(name, "0")  # the benchmark sets them for itself alone


@pytest.fixture(scope="module", autouse=True)
def _forks() -> Iterator[None]:
    """Fork lifters and trainings, as that saves the seconds of their imports."""
    with forked_programs(TRAINING):
        yield


def rows(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_the_video_becomes_a_bag_of_all_people_in_it(tmp_path: Path) -> None:
    person = [v for k in range(25) for v in (100.0 + k, 200.0 + k, 0.9 if k else 0.0)]
    (tmp_path / "detections").mkdir()
    with gzip.open(tmp_path / train_from_bags.VIDEO, "wt") as lines:
        for count in (1, 2, 0):
            people = [{"pose_keypoints_2d": person}] * count
            lines.write(json.dumps({"people": people}) + "\n")
    session = train_from_bags.Session(tmp_path, tmp_path / "out", None, 1)
    bag = session.bag("video", lambda: train_from_bags._people(tmp_path / train_from_bags.VIDEO))
    reading = read_bags([bag], BODY25, HUMAN17, ReadOptions(train_from_bags.TOPIC))
    assert (reading.messages, reading.unreadable, len(reading.dataset)) == (3, 0, 3)
    nose = HUMAN17.index("nose")
    assert not reading.dataset.visible[:, nose].any()
    assert reading.dataset.visible.sum() == 3 * (len(HUMAN17) - 1)


def test_a_bag_that_was_cut_off_is_written_anew(tmp_path: Path) -> None:
    session = train_from_bags.Session(tmp_path, tmp_path, None, 1)
    recording = excavator.record(5, 0)
    (tmp_path / "machine").mkdir()
    (tmp_path / "machine" / "machine.db3").write_bytes(b"half")
    bag = session.bag("machine", lambda: train_from_bags._work(recording))
    assert (bag / "metadata.yaml").exists()
    session.bag("machine", lambda: pytest.fail("it is there"))


def test_the_machine_from_bag_to_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(train_from_bags, "TRAINING_FRAMES", 200)
    monkeypatch.setattr(train_from_bags, "TEST_FRAMES", 50)
    words = ["machine", "--data", "unused", "--output", str(tmp_path), "--steps", "30"]
    train_from_bags.main(words)
    table = rows(tmp_path / "from_excavator.csv")
    assert [row["frames"] for row in table] == ["200"] * 3 + ["50"] * 3
    assert all(0 < float(row["proper %"]) < 150 for row in table)
    assert 0 < float(table[0]["metres"]) < 10
    capfd.readouterr()
    train_from_bags.main(words)
    assert "training" not in capfd.readouterr().err
    assert rows(tmp_path / "from_excavator.csv") == table


def test_the_service_makes_the_model_that_the_program_makes(tmp_path: Path, data: Path) -> None:
    train_from_bags.main(["mocap", "--data", str(data), "--output", str(tmp_path), "--steps", "5"])
    table = rows(tmp_path / "from_mocap.csv")
    direct, served = table[:2], table[2:4]
    assert [row["lifted"] for row in direct] == ["network alone", "as shipped"]
    for one, other in zip(direct, served, strict=True):
        figures = {"shape %", "proper %", "mirrored %", "reprojection", "cycle"}
        for name in figures:
            assert float(one[name]) == pytest.approx(float(other[name]), rel=1e-3)


def test_a_part_that_is_none_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        train_from_bags.main(["nothing", "--data", "unused"])
    assert end.value.code == 2
    assert "no part nothing; there are video, machine, mocap" in capsys.readouterr().err
