# SPDX-License-Identifier: Apache-2.0
"""A database of motion capture like CMU's, made up: every subject, a few frames each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from deep_nrsfm_ros.layouts.presets import CMU31

SUBJECTS = ("01", "02", "03", "05", "14", "49", "60", "61", "86", "127", "131")
TRIALS, FRAMES = 5, 8


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder that holds cmu/."""
    folder = tmp_path_factory.mktemp("data")
    for i, subject in enumerate(SUBJECTS):
        _write_subject(folder / "cmu" / subject, np.random.default_rng(i))
    return folder


def _write_subject(folder: Path, rng: np.random.Generator) -> None:
    folder.mkdir(parents=True)
    (folder / f"{folder.name}.asf").write_text(_skeleton(rng))
    for trial in range(1, TRIALS + 1):
        (folder / f"{folder.name}_{trial:02}.amc").write_text(_motion(rng))


def _skeleton(rng: np.random.Generator) -> str:
    lines, hierarchy = [":bonedata"], [":hierarchy", "begin"]
    for bone, parent in CMU31.edges:
        x, y, z = rng.standard_normal(3)
        lines += ["begin", f"name {bone}", f"direction {x} {y} {z}", "length 3"]
        lines += ["axis 0 0 0 XYZ", "dof rx ry rz", "end"]
        hierarchy.append(f"{parent} {bone}")
    return "\n".join([*lines, *hierarchy, "end", ""])


def _motion(rng: np.random.Generator) -> str:
    lines = [":DEGREES"]
    for frame in range(FRAMES):
        lines += [str(frame + 1), "root 0 0 0 0 0 0"]
        for bone, _ in CMU31.edges:
            lines.append(" ".join([bone, *map(str, rng.uniform(-40, 40, 3))]))
    return "\n".join([*lines, ""])
