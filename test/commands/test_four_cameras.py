# SPDX-License-Identifier: Apache-2.0
"""The table of real detections, on a made-up session."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.commands.evaluate import main
from deep_nrsfm_ros.data.cameras import Camera
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.model_files.model_file import Model, save_model
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser

WHEEL = "pose2sim-0.6.0-py3-none-any.whl"


def test_a_row_for_each_camera_with_and_without_intrinsics(
    tmp_path: Path, ring: list[Camera], write_session: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    write_session(tmp_path / WHEEL, ring, ring, [0.0] * 4)
    network = initialise(Architecture(widths=(16, 8)), len(HUMAN17), np.random.default_rng(0))
    model = Model("untrained", network, HUMAN17, Normaliser(), np.eye(3, dtype=np.float32))
    path = tmp_path / "untrained.safetensors"
    save_model(path, model)
    main([str(path), "--pose2sim", str(tmp_path / WHEEL)])
    rows = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines() if "|" in line]
    cells = [[cell.strip() for cell in row] for row in rows if "untrained" in row[0]]
    cameras = [*(camera.name for camera in ring), "mean"]
    assert [row[2] for row in cells] == 2 * cameras
    assert all(row[7:] == ["", ""] for row in cells[:5])
    for row in cells[5:]:
        # Untrained, so the size is wrong by any factor, but the body is 3.2 m ahead.
        assert 0 < float(row[7]) < 10000 and float(row[7]) != float(row[8])
    errors = np.array([[float(cell) for cell in row[3:7]] for row in cells])
    np.testing.assert_allclose(errors[4], errors[:4].mean(0), atol=0.1)
    assert (errors[5:, 0] != errors[:5, 0]).all()


def test_a_file_that_is_no_wheel_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / WHEEL).write_bytes(b"no zip")
    with pytest.raises(SystemExit, match="2"):
        main(["human", "--pose2sim", str(tmp_path / WHEEL)])
    assert "is damaged" in capsys.readouterr().err
