# SPDX-License-Identifier: Apache-2.0
"""Where models are looked for, and in which order."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from deep_nrsfm_ros.model_files.folders import default_models_dir, in_words, model_folders


def test_the_users_folder_is_in_ros_home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("ROS_HOME", str(tmp_path))
    assert default_models_dir() == tmp_path / "deep_nrsfm_ros" / "models"
    monkeypatch.delenv("ROS_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert default_models_dir() == tmp_path / ".ros" / "deep_nrsfm_ros" / "models"


def test_own_models_come_before_installed_ones_and_those_before_the_sources(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path / 'a'}:{tmp_path / 'b'}")
    shares = [Path(p) / "share/deep_nrsfm_ros/models" for p in (tmp_path / "a", tmp_path / "b")]
    own, *rest = model_folders(tmp_path / "own")
    assert own == tmp_path / "own"
    assert rest[:2] == shares
    assert rest[2] == Path(sys.prefix) / "share/deep_nrsfm_ros/models"
    assert rest[-1].name == "models" and (rest[-1].parent / "deep_nrsfm_ros").is_dir()


def test_a_message_names_the_models_of_the_package_once(tmp_path: Path) -> None:
    assert in_words(model_folders(tmp_path)) == f"{tmp_path}, the package's models"
    assert in_words([tmp_path]) == str(tmp_path)


def test_the_node_does_not_import_torch() -> None:
    code = "import sys, deep_nrsfm_ros.node.lifter; sys.exit('torch' in sys.modules)"
    root = Path(__file__).resolve().parents[2]
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False).returncode == 0
