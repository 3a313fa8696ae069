"""The demo session of Pose2Sim: real detections of one person by four calibrated cameras.

The wheel pose2sim 0.6.0 (BSD-3) carries it. Triangulating the four views gives 3D ground truth
for real detections in each single view.
"""

from __future__ import annotations

import re
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from deep_nrsfm_ros.data.cameras import Array, Camera, triangulate
from deep_nrsfm_ros.data.openpose import largest, read_people
from deep_nrsfm_ros.layouts.presets import BODY25B, HUMAN17
from deep_nrsfm_ros.lifting.observation import Observation

RATE = 60.0
"""Frames a second of the cameras."""
JOINTS = HUMAN17.keypoints[:12]
"""The 12 limb joints of the ground truth: shoulders, elbows, wrists, hips, knees, ankles."""

_CALIBRATION = re.compile(r".*S00_Demo_Session/S00_Calibration/Calib\.qca\.txt")
_DETECTION = re.compile(
    r".*S00_Demo_Session/.*BalancingTrial/pose/(cam\d+)_json/cam\d+\.(\d+)\.json"
)
_VIDEO = re.compile(r".*S00_Demo_Session/.*_(\w+)Trial/videos/(cam\d+)\.mp4")
_SUBPIXELS = 64  # Qualisys counts 64 to a pixel
# How far refinement may easily go from the calibration, which also holds the free scale.
_PRIOR = np.array([0.02, 0.02, 0.02, 100, 100, 100, 2])  # rad, mm, frames


@dataclass(frozen=True)
class View:
    """What one camera saw of the subject, and where the subject was.

    camera: as refined. points: (f, 25, 2) pixels and confidence: (f, 25), layout BODY25B.
    delay: frames by which the camera is behind the first one.
    truth: (f, 12, 3) mm, `JOINTS` in the camera's optical frame; NaN where unknown.
    """

    camera: Camera
    points: NDArray[np.float32]
    confidence: NDArray[np.float32]
    delay: float
    truth: Array


@dataclass(frozen=True)
class Session:
    """The four views and the triangulated ground truth.

    world: (f, 12, 3) mm, `JOINTS` at the times of the first camera; NaN where unknown.
    pixels: (mean, median) reprojection error, and `pixels_given` that of the calibration as given.
    """

    views: tuple[View, ...]
    world: Array
    pixels: tuple[float, float]
    pixels_given: tuple[float, float]


def read_session(wheel: Path) -> Session:
    """Read the balancing trial from the wheel and triangulate it.

    Raises ValueError when the file is no wheel with the session in it.
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
    for camera, seen, delay in zip(refined, detections, delays.tolist(), strict=True):
        truth, known = _at(world, np.isfinite(world[..., 0]) * 1.0, -delay)
        truth[known == 0] = np.nan
        views.append(View(camera, seen.points, seen.confidence, delay, camera.to_camera(truth)))
    return Session(tuple(views), world, _summary(errors), _summary(given))


def extract_videos(wheel: Path, trial: str, folder: Path) -> dict[str, Path]:
    """Write the videos of the "Balancing" or the "Static" trial to a folder; return camera -> file.

    Raises ValueError when the file is no wheel with such videos in it.
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
    """Return the cameras of the Qualisys calibration file, world unit mm."""
    name = next(filter(_CALIBRATION.fullmatch, archive.namelist()), None)
    if name is None:
        raise LookupError("no Calib.qca.txt of the demo session")
    nodes = ElementTree.fromstring(archive.read(name)).iter("camera")
    return [_camera(f"cam{i:02}", node) for i, node in enumerate(nodes, 1)]


def _camera(name: str, node: ElementTree.Element) -> Camera:
    """Return the camera of one <camera> element; raise LookupError for a missing value."""

    def values(tag: str, *keys: str) -> Array:
        return np.array([float(node.findall(tag)[0].attrib[key]) for key in keys])

    turn = values("transform", *(f"r{row}{column}" for row in "123" for column in "123"))
    place = values("transform", "x", "y", "z")
    focal = values("intrinsic", "focalLengthU", "focalLengthV") / _SUBPIXELS
    center = values("intrinsic", "centerPointU", "centerPointV") / _SUBPIXELS
    lens = (f"{kind}Distortion{i}" for kind in ("radial", "tangental") for i in "12")
    width, height = values("fov_video", "right", "bottom") + 1
    # Qualisys looks along -z with y up.
    rotation = np.diag([1.0, -1.0, -1.0]) @ turn.reshape(3, 3)
    return Camera(
        name,
        np.array([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]]),
        values("intrinsic", *lens),
        rotation,
        -rotation @ place,
        (int(width), int(height)),
    )


def _detections(archive: zipfile.ZipFile, camera: str) -> Observation:
    """Return the subject, the largest person, in every frame of a camera."""
    found = {
        int(match[2]): match[0]
        for match in map(_DETECTION.fullmatch, archive.namelist())
        if match and match[1] == camera
    }
    if not found:
        raise LookupError(f"no detections of {camera} in the balancing trial")
    points = np.zeros((max(found) + 1, len(BODY25B), 2), np.float32)
    confidence = np.zeros(points.shape[:2], np.float32)
    for frame, name in found.items():
        people = read_people(archive.read(name), len(BODY25B))
        subject = largest(people)
        if subject is not None:
            points[frame] = people.points[subject]
            confidence[frame] = people.confidence[subject]
    return Observation(points, confidence)


def refine(cameras: list[Camera], pixels: Array, weights: Array) -> tuple[list[Camera], Array]:
    """Return the cameras and their delays (c,) in frames, fitted to what they saw.

    The first camera is held. pixels: (c, f, j, 2) undistorted; weights: (c, f, j).
    """

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
    """Triangulate with each camera's detections moved to the times of the first one."""
    moved = [_at(*view) for view in zip(pixels, weights, delays, strict=True)]
    points, sure = (np.stack(part) for part in zip(*moved, strict=True))
    return triangulate([c.without_lens() for c in cameras], points, sure)


def _at(values: Array, weights: Array, delay: float) -> tuple[Array, Array]:
    """Return values (f, ..., d) and weights (f, ...) `delay` frames later, between frames linear.

    The weight is 0 before the first frame, after the last and where a neighbour is missing.
    """
    times = np.arange(len(values)) + delay
    before = np.clip(np.floor(times).astype(int), 0, len(values) - 1)
    after = np.clip(np.ceil(times).astype(int), 0, len(values) - 1)
    share = (times - before).reshape(-1, *[1] * (values.ndim - 1))
    inside = (times >= 0) & (times <= len(values) - 1)
    sure = np.minimum(weights[before], weights[after])
    sure = np.where(inside.reshape(-1, *[1] * (weights.ndim - 1)), sure, 0.0)
    return (1 - share) * values[before] + share * values[after], sure


def _summary(errors: Array) -> tuple[float, float]:
    """Return the mean and the median length of residuals (..., 2)."""
    lengths = np.linalg.norm(errors, axis=-1)
    return float(np.nanmean(lengths)), float(np.nanmedian(lengths))
