# SPDX-License-Identifier: Apache-2.0
"""The demo session is read as it is: from a small one made here, and from the wheel if at hand."""

import os
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from deep_nrsfm_ros.data.cameras import Camera
from deep_nrsfm_ros.data.pose2sim import JOINTS, read_session
from deep_nrsfm_ros.layouts.presets import BODY25B

WHEEL = "pose2sim-0.6.0-py3-none-any.whl"
LIMBS = [BODY25B.index(joint) for joint in JOINTS]


def test_exact_session(tmp_path: Path, ring: list[Camera], moving: Any, write_session: Any) -> None:
    write_session(tmp_path / WHEEL, ring, ring, [0.0] * 4)
    session = read_session(tmp_path / WHEEL)
    truth = moving(np.arange(30))
    inner = slice(1, -1)  # a camera a millionth of a frame late does not see the last one
    np.testing.assert_allclose(session.world[inner], truth[inner, LIMBS], atol=0.5)
    assert max(*session.pixels, *session.pixels_given) < 0.05
    for view, camera in zip(session.views, ring, strict=True):
        assert (view.camera.name, view.camera.size) == (camera.name, camera.size)
        inside = camera.to_camera(truth)[inner, LIMBS]
        np.testing.assert_allclose(view.truth[inner], inside, atol=1)
        np.testing.assert_allclose(view.points[0, 5], camera.project(truth)[0, 5], atol=1e-3)
        assert view.confidence.shape == (30, 25) and view.truth[inner, :, 2].min() > 2000
    assert not session.views[2].confidence[:, BODY25B.index("left_wrist")].any()


def test_refinement_finds_what_the_calibration_missed(
    tmp_path: Path, ring: list[Camera], moving: Any, write_session: Any
) -> None:
    cameras, delays = ring, [0.0, 0.6, -0.4, 0.3]
    wrong = Rotation.from_rotvec([0.008, -0.006, 0.004]).as_matrix()
    told = [
        camera if i == 0 else replace(camera, rotation=wrong @ camera.rotation)
        for i, camera in enumerate(cameras)
    ]
    write_session(tmp_path / WHEEL, told, cameras, delays)
    session = read_session(tmp_path / WHEEL)
    assert session.pixels_given[0] > 3 and session.pixels[0] < 0.5
    np.testing.assert_allclose([view.delay for view in session.views], delays, atol=0.05)
    for view, camera, delay in zip(session.views, cameras, delays, strict=True):
        truth = camera.to_camera(moving(np.arange(30) - delay))[2:-2, LIMBS]
        shape = truth - truth.mean(1, keepdims=True)
        found = view.truth[2:-2] - view.truth[2:-2].mean(1, keepdims=True)
        np.testing.assert_allclose(found, shape, atol=15)  # the scale is known to about 1 %


def test_foreign_files_are_refused(tmp_path: Path, ring: list[Camera], write_session: Any) -> None:
    wheel = tmp_path / WHEEL
    wheel.write_bytes(b"no zip")
    with pytest.raises(ValueError, match=f"{WHEEL} is damaged"):
        read_session(wheel)
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("pose2sim/__init__.py", "")
    with pytest.raises(ValueError, match=r"is not pose2sim 0\.6\.0: no Calib"):
        read_session(wheel)
    write_session(wheel, ring, ring[:1], [0.0])
    with pytest.raises(ValueError, match="no detections of cam02"):
        read_session(wheel)


def test_the_real_session() -> None:
    wheel = Path(os.environ.get("POSE2SIM_WHEEL", f".cache/{WHEEL}"))
    if not wheel.exists():
        pytest.skip(f"{wheel} is not there; `make demo-live` fetches it")
    session = read_session(wheel)
    assert [view.points.shape for view in session.views] == [(100, 25, 2)] * 4
    assert session.pixels_given[0] == pytest.approx(15.9, abs=0.5)
    assert session.pixels[0] == pytest.approx(9.5, abs=0.5) and session.pixels[1] < 6
    bones = [("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle")]
    for side in ("left", "right"):
        for ends in bones:
            a, b = (session.world[:, JOINTS.index(f"{side}_{end}")] for end in ends)
            length = np.linalg.norm(a - b, axis=-1)
            assert 230 < np.nanmean(length) < 450 and np.nanstd(length) < 0.12 * np.nanmean(length)
