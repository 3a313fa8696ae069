# SPDX-License-Identifier: Apache-2.0
"""Progress is shown from time to time, and once at its end."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import pytest

from deep_nrsfm_ros.data.keypoint_files import read_keypoints
from deep_nrsfm_ros.training.reporter import Reporter


def reporter(*, as_json: bool = False) -> Reporter:
    return Reporter(as_json, should_stop=lambda: False)


def test_an_end_that_is_reached_again_and_again_is_shown_once(
    capsys: pytest.CaptureFixture[str],
) -> None:
    bar = reporter()
    for done in (*range(5), *[5] * 1000):
        bar.reading(done, 5)
    assert capsys.readouterr().err.count("\n") == 1
    lines = reporter(as_json=True)
    for done in (*range(5), *[5] * 1000):
        lines.reading(done, 5)
    shown = [json.loads(line)["step"] for line in capsys.readouterr().out.splitlines()]
    assert shown == [0, 5]


def test_the_bar_of_a_second_count_of_the_same_size_ends_too(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter(range(100))
    monkeypatch.setattr("deep_nrsfm_ros.training.reporter.time.monotonic", lambda: next(clock))
    bar = reporter()
    for done in (0, 5, 0, 5):
        bar.curating(done, 5)
    assert capsys.readouterr().err.count("100%") == 2
    assert bar._bar is None


def test_many_small_files_are_one_bar(capsys: pytest.CaptureFixture[str]) -> None:
    bar = reporter()
    for size in range(10, 40):
        bar.reading(size, size)
    assert capsys.readouterr().err.count("\n") == 1


def test_a_compressed_file_of_lines_is_one_bar(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    row = json.dumps({"people": [{"pose_keypoints_2d": [100.0, 200.0, 0.9] * 25}]})
    with gzip.open(tmp_path / "a.jsonl.gz", "wt") as file:
        file.write(f"{row}\n" * 3000)
    assert len(read_keypoints(tmp_path / "a.jsonl.gz", on_progress=reporter().reading)) == 3000
    assert capsys.readouterr().err.count("\n") == 1
    size, shares = (tmp_path / "a.jsonl.gz").stat().st_size, list[float]()
    read_keypoints(tmp_path / "a.jsonl.gz", on_progress=lambda done, total: shares.append(done))
    assert max(shares) == size
