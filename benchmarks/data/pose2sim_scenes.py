# SPDX-License-Identifier: Apache-2.0
"""Scenes of the pose2sim clip: detections of four cameras, MediaPipe's results and the truth."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from deep_nrsfm_ros.data.cameras import triangulate
from deep_nrsfm_ros.data.pose2sim import JOINTS, View, extract_videos, fetch_wheel, read_session
from deep_nrsfm_ros.layouts.presets import MEDIAPIPE33
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics

Floats = NDArray[Any]

CACHE = Path(".cache")
"""Download folder of the demo."""
LIMBS = [MEDIAPIPE33.index(joint) for joint in JOINTS]
UP = np.array([0.0, 0.0, 1.0])
"""Against gravity, in the world of the calibration, whose floor is at height 0."""


class PoseDetections(NamedTuple):
    """Results of MediaPipe on the f images of a video; NaN and confidence 0 without a person."""

    points: Floats  # (f, 33, 2) pixels
    confidence: Floats  # (f, 33)
    world: Floats  # (f, 33, 3) metres, camera axes
    seconds: Floats  # (f,) processing time


class Scene(NamedTuple):
    """One trial seen by one camera.

    Attributes:
        camera: name of the camera.
        intrinsics: its intrinsics.
        up: (3,) the direction against gravity in the camera's axes.
        truth: (f, 12, 3) mm, `JOINTS` in the camera's axes.
        mediapipe: results of MediaPipe.
        detections: the detections that come with the clip, None if there are none.
    """

    camera: str
    intrinsics: Intrinsics
    up: Floats
    truth: Floats
    mediapipe: PoseDetections
    detections: View | None


def scenes(output: Path) -> tuple[list[Scene], list[Scene], tuple[float, float]]:
    """Return the scenes of both trials, and the mean reprojection errors of their truths (px)."""
    wheel = fetch_wheel(CACHE)
    session = read_session(wheel)
    cameras = [view.camera for view in session.views]
    moving = detect_trial(wheel, "Balancing", output)
    balancing = [
        Scene(
            view.camera.name,
            view.camera.intrinsics,
            view.camera.rotation @ UP,
            view.truth,
            moving[view.camera.name],
            view,
        )
        for view in session.views
    ]
    still = detect_trial(wheel, "Static", output)
    standing = [still[camera.name] for camera in cameras]
    plain = zip(cameras, standing, strict=True)
    points = np.stack([camera.undistort(mediapipe.points[:, LIMBS]) for camera, mediapipe in plain])
    weights = np.stack([mediapipe.confidence[:, LIMBS] for mediapipe in standing]).astype(float)
    world, reprojection = triangulate([c.without_lens() for c in cameras], points, weights)
    truths = [
        Scene(
            camera.name,
            camera.intrinsics,
            camera.rotation @ UP,
            camera.to_camera(world),
            mediapipe,
            None,
        )
        for camera, mediapipe in zip(cameras, standing, strict=True)
    ]
    pixels = float(np.nanmean(np.linalg.norm(reprojection, axis=-1)))
    return balancing, truths, (session.pixels[0], pixels)


def detect_trial(wheel: Path, trial: str, output: Path) -> dict[str, PoseDetections]:
    """Return camera -> results of MediaPipe, from the output folder if they exist.

    Raises:
        ValueError: MediaPipe is needed and not installed.
    """
    folder = output / "mediapipe-0.10.14" / trial
    found = {}
    for camera, video in extract_videos(wheel, trial, folder).items():
        kept, partial = folder / f"{camera}.npz", folder / f"{camera}_partial.npz"
        if not kept.exists():
            np.savez(partial, **detect_video(video)._asdict())
            partial.replace(kept)
        with np.load(kept) as arrays:
            found[camera] = PoseDetections(*(arrays[name] for name in PoseDetections._fields))
    return found


def detect_video(video: Path) -> PoseDetections:
    """Run MediaPipe on a video."""
    try:
        from deep_nrsfm_ros.node.mediapipe_detector import LANDMARKS, Detector, images
    except ImportError as error:
        raise ValueError(f"{error}; `make demo-live` installs MediaPipe") from None
    detect = Detector()
    no_person = (
        np.full((LANDMARKS, 2), np.nan),
        np.zeros(LANDMARKS),
        np.full((LANDMARKS, 3), np.nan),
    )

    def frames() -> Iterator[tuple[Floats, Floats, Floats, float]]:
        for _, image in tqdm(images(str(video)), desc=f"MediaPipe on {video.name}"):
            begin = time.perf_counter()
            found = detect(image) or no_person
            yield *found, time.perf_counter() - begin

    return PoseDetections(*(np.array(part) for part in zip(*frames(), strict=True)))
