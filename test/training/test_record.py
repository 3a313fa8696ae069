"""What a training leaves behind when it is cut off, and what is said of it."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import pytest

from deep_nrsfm_ros.training.record import (
    checkpoint_file,
    find_records,
    keep_record,
    lasting,
    look,
    record_file,
)


def cut_off(folder: Path, name: str, asked: object, age: float, *, saved: bool = True) -> None:
    record_file(folder, name).write_text(json.dumps(asked))
    files = [record_file(folder, name)]
    if saved:
        checkpoint_file(folder, name).touch()
        files.append(checkpoint_file(folder, name))
    for file in files:
        os.utime(file, (time.time() - age,) * 2)


def test_all_that_was_cut_off_is_found_the_newest_first(tmp_path: Path) -> None:
    cut_off(tmp_path, "door", {"bag": ["/a", "/b"], "topic": "/k", "object": ""}, 200)
    cut_off(tmp_path, "dog.v2", {"cmu": None, "steps": 9}, 7200, saved=False)
    cut_off(tmp_path, "cat", ["no", "options"], 400000)
    record_file(tmp_path, "gone").touch()  # cut off in the moment it began
    (tmp_path / "mine.safetensors").touch()
    door, dog, cat = find_records(tmp_path)
    assert str(door) == (
        f"unfinished training of 'door' in {tmp_path}, last saved 3 min ago (bag /a /b; topic /k)"
    )
    assert "'dog.v2'" in str(dog) and "begun 2 h ago and not saved since: it begins anew" in str(
        dog
    )
    assert "last saved 5 days ago" in str(cat) and "no record" in cat.advice
    assert "set train.name to 'door' and train.resume to true" in door.advice
    assert f"train --resume --name door --output {tmp_path}; to give it up, delete" in door.advice
    assert find_records(tmp_path / "nowhere") == []


def test_a_record_stays_only_with_a_checkpoint(tmp_path: Path) -> None:
    with keep_record(tmp_path / "new", "mine", {"steps": 3}, resume=False):
        found = look(tmp_path / "new", "mine")
        assert found is not None and found.running and found.asked == {"steps": 3}
    assert list((tmp_path / "new").iterdir()) == []
    with keep_record(tmp_path, "mine", {"steps": 4}, resume=False) as checkpoint:
        checkpoint.touch()
    found = look(tmp_path, "mine")
    assert found is not None and found.saved and not found.running
    with keep_record(tmp_path, "mine", {"steps": 5}, resume=True) as checkpoint:
        assert checkpoint.exists()
    with keep_record(tmp_path, "mine", {"steps": 6}, resume=False) as checkpoint:
        assert not checkpoint.exists()
    assert look(tmp_path, "mine") is None


def test_paths_that_last_are_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dog.yaml").touch()
    (tmp_path / "human17").touch()
    asked = {"bag": [Path("a"), Path("/b")], "object": "dog.yaml", "start": "human17", "steps": 3}
    here = str(tmp_path)
    assert lasting(asked) == {
        "bag": [f"{here}/a", "/b"],
        "object": f"{here}/dog.yaml",
        "start": "human17",
        "steps": 3,
    }
