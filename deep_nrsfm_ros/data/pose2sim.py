# SPDX-License-Identifier: Apache-2.0
"""The demo session of Pose2Sim: real detections of one person by four calibrated cameras.

The session is part of the wheel pose2sim 0.6.0 (BSD-3). Triangulation of the four views gives 3D
ground truth for the real detections of each view.
"""

from __future__ import annotations

import re
import subprocess
import sys
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.cameras import Array, Camera, triangulate
from deep_nrsfm_ros.data.openpose import largest, read_people
from deep_nrsfm_ros.layouts.presets import BODY25B, HUMAN17
from deep_nrsfm_ros.lifting.observation import Observation

WHEEL = "pose2sim-0.6.0-py3-none-any.whl"
RATE = 60.0
"""Frames per second of the cameras."""
JOINTS = HUMAN17.keypoints[:12]
"""The 12 limb joints of the ground truth: shoulders, elbows, wrists, hips, knees, ankles."""

_CALIBRATION = re.compile(r".*S00_Demo_Session/S00_Calibration/Calib\.qca\.txt")
_DETECTION = re.compile(
    r".*S00_Demo_Session/.*BalancingTrial/pose/(cam\d+)_json/cam\d+\.(\d+)\.json"
)
_VIDEO = re.compile(r".*S00_Demo_Session/.*_(\w+)Trial/videos/(cam\d+)\.mp4")
_SUBPIXELS = 64  # Qualisys units per pixel
# Standard deviations of the refinement around the calibration. They also fix the free scale.
_PRIOR = np.array([0.02, 0.02, 0.02, 100, 100, 100, 2])  # rad, mm, frames


@dataclass(frozen=True)
class View:
    """The detections of one camera, with ground truth.

    Attributes:
        camera: after refinement.
        points: (f, q, 2) in pixels, layout BODY25B unless a clip says another.
        confidence: (f, q) in [0, 1].
        delay: frames by which the camera is behind the first camera.
        truth: (f, 12, 3) positions of `JOINTS` in the camera's optical frame, in mm; NaN where
            unknown.
    """

    camera: Camera
    points: NDArray[np.float32]
    confidence: NDArray[np.float32]
    delay: float
    truth: Array


@dataclass(frozen=True)
class Session:
    """The four views and the triangulated ground truth.

    Attributes:
        views: one for each camera.
        world: (f, 12, 3) positions of `JOINTS` at the times of the first camera, in mm; NaN where
            unknown.
        pixels: mean and median reprojection error in pixels, after refinement.
        pixels_given: the same of the original calibration.
    """

    views: tuple[View, ...]
    world: Array
    pixels: tuple[float, float]
    pixels_given: tuple[float, float]


def fetch_wheel(cache: Path) -> Path:
    """Return the wheel that contains the session; download it from PyPI if it is not in `cache`.

    Raises:
        OSError: the download fails.
    """
    wheel, partial = cache / WHEEL, cache / "partial"
    if not wheel.exists():
        print("- fetching the detections (pose2sim 0.6.0, BSD-3, 23 MB)", flush=True)
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest"]
        try:
            subprocess.run([*command, str(partial), "pose2sim==0.6.0"], check=True)
        except subprocess.CalledProcessError:
            raise OSError(f"pip cannot fetch pose2sim 0.6.0; put {WHEEL} into {cache}") from None
        (partial / WHEEL).replace(wheel)
    return wheel


def read_session(wheel: Path) -> Session:
    """Return the balancing trial of the wheel, triangulated.

    Raises:
        ValueError: the file is not the wheel pose2sim 0.6.0.
    """
    try:
        with zipfile.ZipFile(wheel) as archive:
            cameras = _cameras(archive)
            detections = [_detections(archive, camera.name) for camera in cameras]
    except (zipfile.BadZipFile, ElementTree.ParseError) as error:
        raise ValueError(f"{wheel} is damaged: {error}; download it again") from None
    except LookupError as error:
        raise ValueError(f"{wheel} is not pose2sim 0.6.0: {error}") from None
    limbs = [BODY25B.index(joint) for joint in JOINTS]
    pixels = np.stack(
        [
            c.undistort(d.points[:, limbs].astype(float))
            for c, d in zip(cameras, detections, strict=True)
        ]
    )
    weights = np.stack([d.confidence[:, limbs] for d in detections]).astype(float)
    _, given = triangulate([c.without_lens() for c in cameras], pixels, weights)
    refined, delays = refine(cameras, pixels, weights)
    world, errors = _synchronous(refined, delays, pixels, weights)
    views = []
    for camera, subject, delay in zip(refined, detections, delays.tolist(), strict=True):
        truth, known = _at(world, np.isfinite(world[..., 0]) * 1.0, -delay)
        truth[known == 0] = np.nan
        truth = camera.to_camera(truth)
        views.append(View(camera, subject.points, subject.confidence, delay, truth))
    return Session(tuple(views), world, _summary(errors), _summary(given))


def extract_videos(wheel: Path, trial: str, folder: Path) -> dict[str, Path]:
    """Write the videos of a trial to a folder, and return the file of each camera.

    Args:
        wheel: the wheel pose2sim 0.6.0.
        trial: "Balancing" or "Static".
        folder: is made if it does not exist.

    Raises:
        ValueError: the file is no such wheel.
    """
    folder.mkdir(parents=True, exist_ok=True)
    videos = {}
    try:
        with zipfile.ZipFile(wheel) as archive:
            for match in filter(None, map(_VIDEO.fullmatch, sorted(archive.namelist()))):
                if match[1] == trial:
                    videos[match[2]] = folder / f"{match[2]}.mp4"
                    videos[match[2]].write_bytes(archive.read(match[0]))
    except zipfile.BadZipFile as error:
        raise ValueError(f"{wheel} is damaged: {error}; download it again") from None
    if not videos:
        raise ValueError(f"{wheel} is not pose2sim 0.6.0: no videos of the trial {trial!r}")
    return videos


def _cameras(archive: zipfile.ZipFile) -> list[Camera]:
    """Return the cameras of the Qualisys calibration file; the world unit is mm."""
    name = next(filter(_CALIBRATION.fullmatch, archive.namelist()), None)
    if name is None:
        raise LookupError("no Calib.qca.txt of the demo session")
    nodes = ElementTree.fromstring(archive.read(name)).iter("camera")
    return [_camera(f"cam{i:02}", node) for i, node in enumerate(nodes, 1)]


def _camera(name: str, node: ElementTree.Element) -> Camera:
    """Return the camera of one <camera> element; raise LookupError for a missing value."""

    def values(tag: str, *keys: str) -> Array:
        return np.array([float(node.findall(tag)[0].attrib[key]) for key in keys])

    axes = values("transform", *(f"r{row}{column}" for row in "123" for column in "123"))
    position = values("transform", "x", "y", "z")
    focal = values("intrinsic", "focalLengthU", "focalLengthV") / _SUBPIXELS
    center = values("intrinsic", "centerPointU", "centerPointV") / _SUBPIXELS
    lens = (f"{kind}Distortion{i}" for kind in ("radial", "tangental") for i in "12")
    width, height = values("fov_video", "right", "bottom") + 1
    # A Qualisys camera looks along -z and has y up.
    rotation = np.diag([1.0, -1.0, -1.0]) @ axes.reshape(3, 3)
    return Camera(
        name,
        np.array([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]]),
        values("intrinsic", *lens),
        rotation,
        -rotation @ position,
        (int(width), int(height)),
    )


def _detections(archive: zipfile.ZipFile, camera: str) -> Observation:
    """Return the subject, the largest person, in every frame of a camera."""
    files = {
        int(match[2]): match[0]
        for match in map(_DETECTION.fullmatch, archive.namelist())
        if match and match[1] == camera
    }
    if not files:
        raise LookupError(f"no detections of {camera} in the balancing trial")
    points = np.zeros((max(files) + 1, len(BODY25B), 2), np.float32)
    confidence = np.zeros(points.shape[:2], np.float32)
    for frame, name in files.items():
        people = read_people(archive.read(name), len(BODY25B))
        subject = largest(people)
        if subject is not None:
            points[frame] = people.points[subject]
            confidence[frame] = people.confidence[subject]
    return Observation(points, confidence)


def refine(cameras: list[Camera], pixels: Array, weights: Array) -> tuple[list[Camera], Array]:
    """Return cameras and delays that fit the detections best; the first camera is fixed.

    Args:
        cameras: c calibrated cameras.
        pixels: (c, f, j, 2) undistorted detections of j joints in f frames.
        weights: (c, f, j) confidences, 0 where missing.

    Returns:
        The refined cameras, and their delays (c,) in frames behind the first one.
    """
    from scipy.optimize import least_squares  # 100 MB that a reader of the views does not need
    from scipy.spatial.transform import Rotation

    def unpack(x: Array) -> tuple[list[Camera], Array]:
        moves = np.concatenate([np.zeros((1, 7)), x.reshape(-1, 7)]) * _PRIOR
        moved = [
            replace(
                camera,
                rotation=Rotation.from_rotvec(move[:3]).as_matrix() @ camera.rotation,
                translation=camera.translation + move[3:6],
            )
            for camera, move in zip(cameras, moves, strict=True)
        ]
        return moved, moves[:, 6]

    def residual(x: Array) -> Array:
        _, errors = _synchronous(*unpack(x), pixels, weights)
        return np.concatenate([np.nan_to_num(weights[..., None] * errors).ravel(), x])

    start = np.zeros(7 * (len(cameras) - 1))
    fit = least_squares(residual, start, loss="soft_l1", f_scale=5.0, ftol=1e-4, max_nfev=30)
    return unpack(fit.x)


def _synchronous(
    cameras: list[Camera], delays: Array, pixels: Array, weights: Array
) -> tuple[Array, Array]:
    """Triangulate, with the detections of each camera shifted to the times of the first one."""
    moved = [_at(*view) for view in zip(pixels, weights, delays, strict=True)]
    points, confidence = (np.stack(part) for part in zip(*moved, strict=True))
    return triangulate([c.without_lens() for c in cameras], points, confidence)


def _at(values: Array, weights: Array, delay: float) -> tuple[Array, Array]:
    """Return values (f, ..., d) and weights (f, ...) `delay` frames later, interpolated linearly.

    The weight is 0 before the first frame, after the last and where a neighbour is missing.
    """
    times = np.arange(len(values)) + delay
    before = np.clip(np.floor(times).astype(int), 0, len(values) - 1)
    after = np.clip(np.ceil(times).astype(int), 0, len(values) - 1)
    fraction = (times - before).reshape(-1, *[1] * (values.ndim - 1))
    inside = (times >= 0) & (times <= len(values) - 1)
    weight = np.minimum(weights[before], weights[after])
    weight = np.where(inside.reshape(-1, *[1] * (weights.ndim - 1)), weight, 0.0)
    return (1 - fraction) * values[before] + fraction * values[after], weight


def _summary(errors: Array) -> tuple[float, float]:
    """Return the mean and the median length of residuals (..., 2)."""
    lengths = np.linalg.norm(errors, axis=-1)
    return float(np.nanmean(lengths)), float(np.nanmedian(lengths))
