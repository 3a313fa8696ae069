# SPDX-License-Identifier: Apache-2.0
"""torch and rclpy are extras: what needs neither works without them, the rest says what to install.

A meta-path finder stands for an installation without a package, in a process of its own.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from deep_nrsfm_ros.extras import MissingExtraError, is_installed, require_extra

TRAIN = "training needs torch: pip install 'deep_nrsfm_ros[train]'"
ROS = "needs rclpy: pip install 'deep_nrsfm_ros[ros]' (or source your ROS installation)"
WITHOUT = """
import sys
class Without:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {missing!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Without())
from deep_nrsfm_ros.commands.cli import main
main({words!r})
"""


def run_without(missing: tuple[str, ...], *words: str) -> subprocess.CompletedProcess[str]:
    code = WITHOUT.format(missing=missing, words=list(words))
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)


def test_lift_needs_neither_rclpy_nor_torch(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(50, 600, (3, 17, 2))
    np.savez(tmp_path / "points.npz", points=points)
    done = run_without(
        ("rclpy", "torch"),
        *("lift", str(tmp_path / "points.npz"), "--output", str(tmp_path / "lifted.npz")),
        "--force",  # random points fit no model
    )
    assert done.returncode == 0, done.stderr
    assert np.isfinite(np.load(tmp_path / "lifted.npz")["shapes"]).all()


def test_training_without_torch_names_the_extra(tmp_path: Path) -> None:
    done = run_without(("torch",), "train", "--bag", "bag", "--output", str(tmp_path))
    assert done.returncode == 2 and TRAIN in done.stdout + done.stderr


def test_the_lifter_without_rclpy_names_the_extra() -> None:
    done = run_without(("rclpy",), "lifter")
    assert done.returncode == 2 and f"the lifter node {ROS}" in done.stderr


def test_replay_of_a_lifter_without_rclpy_names_the_extra() -> None:
    done = run_without(("rclpy",), "replay", "--serve")
    assert done.returncode == 2 and ROS in done.stderr


def test_the_node_needs_no_torch() -> None:
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "import rclpy; from deep_nrsfm_ros.node.lifter import LifterNode\n"
        "rclpy.init(); LifterNode().destroy_node(); rclpy.shutdown()"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_an_extra_that_is_there_is_not_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    require_extra("train", "training")
    monkeypatch.setitem(sys.modules, "torch", None)
    assert not is_installed("torch")
    with pytest.raises(MissingExtraError) as caught:
        require_extra("train", "training")
    assert str(caught.value) == TRAIN
