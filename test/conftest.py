"""A session like Pose2Sim's, made up: known cameras see a known body that moves."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from deep_nrsfm_ros.nrsfm.keypoints import BODY25B
from deep_nrsfm_ros.observations.cameras import Camera

SESSION = "Pose2Sim/Demo/S00_Demo_Session"
UNSEEN = "left_wrist"  # by cam03


@pytest.fixture
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


@pytest.fixture
def moving() -> Callable[[np.ndarray], np.ndarray]:
    """Return the function that gives the body at any times."""
    return _moving


@pytest.fixture
def write_session() -> Callable[..., None]:
    """Return a function that writes the wheel with the session."""
    return _write_session


def _moving(times: np.ndarray) -> np.ndarray:
    """Return (f, 25, 3) mm of a body that turns and swings, at any times in frames."""
    body = np.random.default_rng(0).uniform(-500, 500, (25, 3))
    turn = Rotation.from_rotvec(np.outer(np.sin(times / 4), [0.1, 0.2, 0.6])).as_matrix()
    swing = 1 + 0.2 * np.sin(times / 3)[:, None, None] * np.linspace(-1, 1, 25)[:, None]
    return np.einsum("fij,pj->fpi", turn, body) * swing


def _calibration(cameras: list[Camera]) -> bytes:
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


def _write_session(
    wheel: Path, told: list[Camera], cameras: list[Camera], delays: list[float], frames: int = 30
) -> None:
    """Write a wheel: what `cameras` see, each `delays` frames late, calibrated as `told`."""
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr(f"{SESSION}/S00_Calibration/Calib.qca.txt", _calibration(told))
        for camera, delay in zip(cameras, delays, strict=True):
            folder = f"{SESSION}/P00/P00_BalancingTrial/pose/{camera.name}_json"
            seen = camera.project(_moving(np.arange(frames) - delay))
            for i, points in enumerate(seen):
                body = np.concatenate([points, np.full((25, 1), 0.8)], -1)
                if camera.name == "cam03":
                    body[BODY25B.index(UNSEEN)] = 0
                bystander = body * [0.3, 0.3, 1]
                people = [{"pose_keypoints_2d": p.ravel().tolist()} for p in (bystander, body)]
                text = json.dumps({"people": people})
                archive.writestr(f"{folder}/{camera.name}.{i:04}.json", text)
