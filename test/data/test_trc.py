# SPDX-License-Identifier: Apache-2.0
"""TRC of Sports2D is read; 3D markers are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.data.keypoint_files import KeypointFileError
from test.data.test_tables import VALUES, read


def trc(values: np.ndarray, names: Any, units: str = "m") -> str:
    head = ["Frame#", "Time", *[cell for name in names for cell in (name, "", "")]]
    lines = [
        ["PathFileType", "4", "(X/Y/Z)", "a.trc"],
        ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units"],
        ["25", "25", str(len(values)), str(len(names)), units],
        head,
        ["", "", *[f"{c}{i}" for i in range(len(names)) for c in "XYZ"]],
        *([str(i + 1), str((i + 10) / 25), *map(str, row.ravel())] for i, row in enumerate(values)),
    ]
    return "\n".join("\t".join(line) for line in lines).replace("nan", "")


def test_trc_of_sports2d(tmp_path: Path) -> None:
    values = VALUES.copy()
    values[..., 2] = 0
    names = ("Nose", "LEar", "REar", "LShoulder")
    found = read(tmp_path / "a_px_person00.trc", trc(values, names))
    expected = ("nose", "left_ear", "right_ear", "left_shoulder")
    assert found.layout and found.layout.keypoints == expected and not found.warnings
    np.testing.assert_allclose(found.points, np.nan_to_num(values[..., :2]), rtol=1e-5)
    assert found.stamps.tolist() == [(i + 10) * 40_000_000 for i in range(5)]
    assert found.frames.numbers.tolist() == [1, 2, 3, 4, 5]
    found = read(tmp_path / "a_m_person00.trc", trc(values / 1000, names))
    assert "taken for metres with y up" in found.warnings[0]
    np.testing.assert_allclose(found.points[0], values[0, :, :2] / [1000, -1000], rtol=1e-5)
    values[..., 2] = VALUES[..., 0]
    with pytest.raises(KeypointFileError, match="its markers are 3D"):
        read(tmp_path / "a.trc", trc(values, names))
    with pytest.raises(KeypointFileError, match="no TRC"):
        read(tmp_path / "a.trc", "hello")
