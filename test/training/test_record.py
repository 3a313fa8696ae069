# SPDX-License-Identifier: Apache-2.0
"""What a training leaves behind when it is cut off, and what is said of it."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

from deep_nrsfm_ros.training.config import TrainingConfig
from deep_nrsfm_ros.training.record import (
    checkpoint_file,
    find_records,
    keep_record,
    read_record,
    record_file,
)


def cut_off(folder: Path, name: str, record: str, age: float, *, saved: bool = True) -> None:
    record_file(folder, name).write_text(record)
    files = [record_file(folder, name)]
    if saved:
        checkpoint_file(folder, name).touch()
        files.append(checkpoint_file(folder, name))
    for file in files:
        os.utime(file, (time.time() - age,) * 2)


def training(folder: Path, **options: Any) -> TrainingConfig:
    return TrainingConfig().with_options({"folder": folder, "name": "mine", **options})


def test_all_that_was_cut_off_is_found_the_newest_first(tmp_path: Path) -> None:
    bags = training(tmp_path, bags=(Path("/a"), Path("/b")), topic="/k", steps=9)
    cut_off(tmp_path, "door", bags.to_json(), 200)
    cut_off(tmp_path, "dog.v2", training(tmp_path, cmu=Path("/c")).to_json(), 7200, saved=False)
    cut_off(tmp_path, "cat", '["no", "options"]', 400000)
    record_file(tmp_path, "gone").touch()  # cut off in the moment it began
    (tmp_path / "mine.safetensors").touch()
    door, dog, cat = find_records(tmp_path)
    assert str(door) == (
        f"unfinished training of 'door' in {tmp_path}, last saved 3 min ago "
        "(bags /a /b; topic /k; steps 9)"
    )
    assert door.config == bags.whole()
    assert "'dog.v2'" in str(dog) and "(cmu /c)" in str(dog)
    assert "begun 2 h ago and not saved since: it begins anew" in str(dog)
    assert "last saved 5 days ago" in str(cat) and "not recorded" in cat.advice
    assert "set train.name to 'door' and train.resume to true" in door.advice
    assert f"train --resume --name door --output {tmp_path}; to give it up, delete" in door.advice
    assert find_records(tmp_path / "nowhere") == []


def test_a_record_stays_only_with_a_checkpoint(tmp_path: Path) -> None:
    new = training(tmp_path / "new", steps=3)
    with keep_record(new):
        record = read_record(tmp_path / "new", "mine")
        assert record is not None and record.running and record.config == new.whole()
    assert list((tmp_path / "new").iterdir()) == []
    with keep_record(training(tmp_path, steps=4)) as checkpoint:
        checkpoint.touch()
    record = read_record(tmp_path, "mine")
    assert record is not None and record.saved and not record.running
    with keep_record(training(tmp_path, steps=5, resume=True)) as checkpoint:
        assert checkpoint.exists()
    with keep_record(training(tmp_path, steps=6)) as checkpoint:
        assert not checkpoint.exists()
    assert read_record(tmp_path, "mine") is None
