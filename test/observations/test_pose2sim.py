"""The demo session is read as it is: from a small one made here, and from the wheel if at hand."""

import json
import os
import zipfile
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from deep_nrsfm_ros.nrsfm.keypoints import BODY25B
from deep_nrsfm_ros.observations.cameras import Camera
from deep_nrsfm_ros.observations.pose2sim import JOINTS, read_session

SESSION = "Pose2Sim/Demo/S00_Demo_Session"
CALIBRATION = f"{SESSION}/S00_Calibration/Calib.qca.txt"
WHEEL = "pose2sim-0.6.0-py3-none-any.whl"
LIMBS = [BODY25B.index(joint) for joint in JOINTS]


def ring() -> list[Camera]:
    """Return four cameras on a circle of 3 m that look at the origin of a z-up world in mm."""
    cameras = []
    for i in range(4):
        around = Rotation.from_euler("z", 90 * i + 20, degrees=True).as_matrix()
        down = Rotation.from_euler("x", 20, degrees=True).as_matrix()
        rotation = down @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ around
        matrix = np.array([[1700.0, 0, 540], [0, 1690, 950], [0, 0, 1]])
        lens = np.array([-0.05, 0.14, 0.0006, 0.0007])
        place = np.array([0.0, 0, 3200])
        cameras.append(Camera(f"cam{i + 1:02}", matrix, lens, rotation, place, (1088, 1920)))
    return cameras


def moving(times: np.ndarray) -> np.ndarray:
    """Return (f, 25, 3) mm of a body that turns and swings, at any times in frames."""
    body = np.random.default_rng(0).uniform(-500, 500, (25, 3))
    turn = Rotation.from_rotvec(np.outer(np.sin(times / 4), [0.1, 0.2, 0.6])).as_matrix()
    swing = 1 + 0.2 * np.sin(times / 3)[:, None, None] * np.linspace(-1, 1, 25)[:, None]
    return np.einsum("fij,pj->fpi", turn, body) * swing


def calibration(cameras: list[Camera]) -> bytes:
    """Return the cameras as a Qualisys file."""
    root = ElementTree.Element("calibration")
    nodes = ElementTree.SubElement(root, "cameras")
    for camera in cameras:
        node = ElementTree.SubElement(nodes, "camera")
        turn = np.diag([1, -1, -1]) @ camera.rotation
        place = -camera.rotation.T @ camera.translation
        transform = {f"r{i + 1}{j + 1}": turn[i, j] for i in range(3) for j in range(3)}
        transform |= dict(zip("xyz", place, strict=True))
        focal, center = camera.matrix.diagonal() * 64, camera.matrix[:2, 2] * 64
        intrinsic = {"focalLengthU": focal[0], "focalLengthV": focal[1]}
        intrinsic |= {"centerPointU": center[0], "centerPointV": center[1]}
        lens = ("radialDistortion1", "radialDistortion2")
        lens += ("tangentalDistortion1", "tangentalDistortion2")
        intrinsic |= dict(zip(lens, camera.distortion, strict=True))
        field = {"right": camera.size[0] - 1, "bottom": camera.size[1] - 1}
        for tag, values in (
            ("transform", transform),
            ("intrinsic", intrinsic),
            ("fov_video", field),
        ):
            ElementTree.SubElement(node, tag, {k: repr(float(v)) for k, v in values.items()})
    return ElementTree.tostring(root)


def write_session(
    wheel: Path, told: list[Camera], cameras: list[Camera], delays: list[float], frames: int = 30
) -> None:
    """Write a wheel: what `cameras` see, each `delays` frames late, calibrated as `told`."""
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr(CALIBRATION, calibration(told))
        for camera, delay in zip(cameras, delays, strict=True):
            folder = f"{SESSION}/P00/P00_BalancingTrial/pose/{camera.name}_json"
            seen = camera.project(moving(np.arange(frames) - delay))
            for i, points in enumerate(seen):
                body = np.concatenate([points, np.full((25, 1), 0.8)], -1)
                if camera.name == "cam03":
                    body[LIMBS[4]] = 0  # a wrist that one camera never sees
                bystander = body * [0.3, 0.3, 1]
                people = [{"pose_keypoints_2d": p.ravel().tolist()} for p in (bystander, body)]
                text = json.dumps({"people": people})
                archive.writestr(f"{folder}/{camera.name}.{i:04}.json", text)


def test_exact_session(tmp_path: Path) -> None:
    write_session(tmp_path / WHEEL, ring(), ring(), [0.0] * 4)
    session = read_session(tmp_path / WHEEL)
    truth = moving(np.arange(30))
    inner = slice(1, -1)  # a camera a millionth of a frame late does not see the last one
    np.testing.assert_allclose(session.world[inner], truth[inner, LIMBS], atol=0.5)
    assert max(*session.pixels, *session.pixels_given) < 0.05
    for view, camera in zip(session.views, ring(), strict=True):
        assert (view.camera.name, view.camera.size) == (camera.name, camera.size)
        inside = camera.to_camera(truth)[inner, LIMBS]
        np.testing.assert_allclose(view.truth[inner], inside, atol=1)
        np.testing.assert_allclose(view.points[0, 5], camera.project(truth)[0, 5], atol=1e-3)
        assert view.confidence.shape == (30, 25) and view.truth[inner, :, 2].min() > 2000
    assert not session.views[2].confidence[:, LIMBS[4]].any()


def test_refinement_finds_what_the_calibration_missed(tmp_path: Path) -> None:
    cameras, delays = ring(), [0.0, 0.6, -0.4, 0.3]
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


def test_foreign_files_are_refused(tmp_path: Path) -> None:
    wheel = tmp_path / WHEEL
    wheel.write_bytes(b"no zip")
    with pytest.raises(ValueError, match=f"{WHEEL} is damaged"):
        read_session(wheel)
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("pose2sim/__init__.py", "")
    with pytest.raises(ValueError, match=r"is not pose2sim 0\.6\.0: no Calib"):
        read_session(wheel)
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr(CALIBRATION, calibration(ring()))
    with pytest.raises(ValueError, match="no detections of cam01"):
        read_session(wheel)


def test_the_real_session() -> None:
    wheel = Path(os.environ.get("POSE2SIM_WHEEL", f".cache/{WHEEL}"))
    if not wheel.exists():
        pytest.skip(f"{wheel} is not there; `make demo` fetches it")
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
