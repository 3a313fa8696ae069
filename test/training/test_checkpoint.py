# SPDX-License-Identifier: Apache-2.0
"""A checkpoint is whole, or the old one stays."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from deep_nrsfm_ros.training import checkpoint
from deep_nrsfm_ros.training.checkpoint import read_checkpoint, write_checkpoint


def test_a_state_comes_back(tmp_path: Path) -> None:
    state = {"weights": torch.arange(6.0).view(2, 3).T, "step": torch.tensor(7)}
    write_checkpoint(tmp_path / "file", state)
    found = read_checkpoint(tmp_path / "file")
    assert found.keys() == state.keys()
    assert all(torch.equal(found[name], tensor) for name, tensor in state.items())
    assert [f.name for f in tmp_path.iterdir()] == ["file"]


def test_a_full_disk_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "file"
    write_checkpoint(file, {"step": torch.tensor(7)})
    before = file.read_bytes()

    def full_disk(tensors: object, path: Path) -> None:
        path.write_bytes(b"half")
        raise OSError("no space left")

    monkeypatch.setattr(checkpoint, "save_file", full_disk)
    with pytest.raises(OSError, match="no space"):
        write_checkpoint(file, {"step": torch.tensor(8)})
    assert file.read_bytes() == before


def test_what_is_no_checkpoint_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"half")
    with pytest.raises(ValueError, match="file cannot be read"):
        read_checkpoint(tmp_path / "file")
