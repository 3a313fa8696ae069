# SPDX-License-Identifier: Apache-2.0
"""The list of models: all there are, where, how good, from what; damaged ones with the reason."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.commands import models
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.model_files.model_file import Model, save_model
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser

PROVENANCE = {"data": "bags kitchen, yard", "frames": 321, "step": 4000, "date": "2025-03-04"}
QUALITY = {"reprojection_error": 0.1234, "cycle_error": 0.5678}


def save(path: Path, layout: KeypointLayout = HUMAN17, **fields: Any) -> Path:
    network = initialise(Architecture(widths=(4,)), len(layout), np.random.default_rng(0))
    frame = np.eye(3, dtype=np.float32)
    model = Model("any", network, layout, Normaliser(), frame, PROVENANCE, QUALITY)
    save_model(path, dataclasses.replace(model, **fields))
    return path


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Return a user's own folder and that of an installation; there are no others."""
    own, shared = tmp_path / "own", tmp_path / "shared"
    monkeypatch.setattr(models, "model_folders", lambda models_dir: [models_dir, shared])
    return own, shared


def listing(capsys: pytest.CaptureFixture[str], own: Path, *options: str) -> list[str]:
    models.main(["--models-dir", str(own), *options])
    return capsys.readouterr().out.splitlines()


def test_a_model_is_listed_with_all_that_is_known_of_it(
    folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    path = save(folders[0] / "mine.safetensors")
    head, row, where, origin, errors, *_ = listing(capsys, folders[0])
    assert tuple(head.split()) == models.COLUMNS
    assert row.split() == ["mine", "human17", "17", "-", "2025-03-04"]
    assert errors.strip() == "on the data of its training: image error 0.123, cycle error 0.568"
    assert where.strip() == str(path)
    assert origin.strip() == "bags kitchen, yard; 321 frames; 4000 steps"


def test_what_a_model_was_started_from_is_said(
    folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    tuned = PROVENANCE | {"from": {"model": "human", "data": "CMU"}}
    save(folders[0] / "tuned.safetensors", provenance=tuned)
    assert any(
        line.endswith("4000 steps; from model human") for line in listing(capsys, folders[0])
    )


def test_a_model_whose_training_was_cut_off_says_so(
    folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    save(folders[0] / "half.safetensors", provenance=PROVENANCE | {"cut_off": True})
    assert "4000 steps; cut off before its end" in " ".join(
        " ".join(listing(capsys, folders[0])).split()
    )


def test_a_training_of_no_steps_has_those_of_its_start(
    folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    first = PROVENANCE | {"model": "human", "step": 40000}
    anew = PROVENANCE | {"step": 0, "last_step": {"data": "virtual people"}, "from": first}
    save(folders[0] / "human.safetensors", provenance=anew)
    text = " ".join(" ".join(listing(capsys, folders[0])).split())
    assert "40000 steps; error covariance and bones from virtual people" in text
    assert "0 steps; from" not in text.replace("40000 steps", "")


def test_models_stand_in_the_order_of_the_judge(
    folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    reasons = {"a": "it mirrors", "b": None, "c": "it is better"}
    for name, reason in reasons.items():
        judgement = {"doubtful": name == "a", "reason": reason, "rival": "human"}
        provenance = PROVENANCE | ({"judgement": judgement} if reason else {})
        # The doubtful model has the lowest errors: on its own data they say nothing.
        quality = {"reprojection_error": 0.01 if name == "a" else 0.1}
        save(folders[0] / f"{name}.safetensors", provenance=provenance, quality=quality)
    (folders[0] / "aa.safetensors").write_bytes(b"\0" * 9)
    lines = listing(capsys, folders[0], "--details")
    rows = [line.split() for line in lines[1 : lines.index("")] if not line.startswith(" ")]
    assert [(row[0], row[3] if len(row) > 3 else "") for row in rows] == [
        ("c", "better"),
        ("b", "-"),
        ("a", "doubtful"),
        ("aa", ""),
    ]
    assert {"it mirrors", "it is better"} <= {line.strip() for line in lines}


def test_a_model_that_says_little_is_listed_too(
    folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    path = save(folders[0] / "old.safetensors", provenance={}, quality={"cycle_error": "good"})
    row, _, origin, *_ = listing(capsys, folders[0])[1:]
    assert row.split()[:4] == ["old", "human17", "17", "-"]
    assert row.split()[4].startswith("~20") and path.exists()  # the day of the file
    assert origin.strip() == "of unknown data"


def test_own_models_hide_those_of_the_package(
    folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    own, shared = folders
    for path in (own / "human.safetensors", shared / "human.safetensors"):
        save(path)
    save(shared / "dog.safetensors", KeypointLayout.numbered(5))
    (own / "again.safetensors").symlink_to(own / "human.safetensors")
    (own / "dog.safetensors").symlink_to(shared / "dog.safetensors")
    lines = listing(capsys, own)
    rows = lines[1 : lines.index("")]
    names = [row.split()[:3] for row in rows if not row.startswith(" ")]
    assert names == [
        ["again", "human17", "17"],
        ["human", "human17", "17"],
        ["human", "human17", "17"],
        ["dog", "points5", "5"],
    ]
    # A long path is on a line of its own.
    text = " ".join(row.strip() for row in rows)
    assert text.count("hidden by") == 1 and f"hidden by {str(own)[:40]}" in text


def test_damaged_files_are_listed_with_the_reason(
    folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    own, shared = folders
    save(shared / "human.safetensors")
    own.mkdir()
    (own / "broken.safetensors").write_bytes(b"\0" * 100)
    (own / "lost.safetensors").symlink_to(own / "nowhere")
    (own / "notes.txt").write_text("no model")
    lines = listing(capsys, own)
    assert [line.split() for line in lines if "unusable" in line and line[0] != " "] == [
        ["broken", "unusable"],
        ["lost", "unusable"],
    ]
    text = " ".join(" ".join(lines).split())
    assert f"{own / 'broken.safetensors'} is damaged or no safetensors file" in text
    assert f"cannot read model {own / 'lost.safetensors'}: No such file" in text
    assert any(line.startswith("human ") for line in lines) and "notes" not in text


def test_no_models_are_said_to_be_none(
    folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        models.main(["--models-dir", str(folders[0])])
    assert end.value.code == 2
    assert f"no models in {folders[0]}, {folders[1]}" in capsys.readouterr().err


def test_the_default_is_the_lifters_folder(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    models.main([])
    lines = capsys.readouterr().out.splitlines()
    assert {"human", "cmu31"} <= {line.split()[0] for line in lines if line}


def test_the_date_of_a_file_is_explained(
    folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    save(folders[0] / "old.safetensors", provenance={"data": "bags"})
    said = listing(capsys, folders[0])
    assert said[1].split()[-1].startswith("~")
    assert "A date with ~ is that of the file" in " ".join(said)


def test_many_models_have_a_line_each_and_the_newest_its_reason(
    folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    for k in range(40):
        said = {"doubtful": k == 7, "reason": f"reason {k}.", "rival": "human"}
        path = save(folders[0] / f"m{k}.safetensors", provenance=PROVENANCE | {"judgement": said})
        os.utime(path, (1e9 + k % 30, 1e9 + k % 30))
    save(folders[1] / "shipped.safetensors")  # newer, but not the user's own
    os.utime(folders[0] / "m7.safetensors", (2e9, 2e9))
    lines = listing(capsys, folders[0])
    table = lines[: lines.index("")]
    assert [line.strip() for line in table if "reason" in line] == ["reason 7."]
    assert len(table) == 1 + 41 + 4 and max(map(len, table[:41])) < 80
    assert sum("reason" in line for line in listing(capsys, folders[0], "--details")) >= 40


def test_each_verdict_has_its_word(
    folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    verdicts = {
        "a": {"doubtful": False, "verdict": "alone"},
        "b": {"doubtful": False, "verdict": "as_good", "rival": "human"},
        "c": {"doubtful": False, "verdict": "better", "rival": "human"},
        "u": {"doubtful": False, "verdict": "unknown", "rival": "human"},
        "d": {"doubtful": False, "rival": "human"},  # of an earlier version
    }
    for name, said in verdicts.items():
        save(folders[0] / f"{name}.safetensors", provenance=PROVENANCE | {"judgement": said})
    rows = [line.split() for line in listing(capsys, folders[0]) if line.split(" ")[0] in verdicts]
    assert {row[0]: row[3] for row in rows} == {
        "a": "alone",
        "b": "as_good",
        "c": "better",
        "d": "better",
        "u": "unknown",
    }
