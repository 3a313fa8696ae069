# SPDX-License-Identifier: Apache-2.0
"""The clips that come with the package: a real person, four calibrated cameras, ground truth.

They are the two trials of Pose2Sim's demo session (`data/pose2sim.py`), made smaller: detections
and ground truth, and the images around the person. `clip_licence.txt` has their licence. Balancing:
the detections and the calibration of the session. Standing: MediaPipe's keypoints of the images,
and ground truth triangulated from them, since the session has no real detections of this trial.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from deep_nrsfm_ros.data.cameras import Array, Camera
from deep_nrsfm_ros.data.pose2sim import Session, View
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import BODY25B, preset

IMAGE_STEP = 2
"""Every second frame has an image."""

BALANCING, STANDING = "balancing", "standing"
FILES = {BALANCING: "clip.npz", STANDING: "clip_standing.npz"}
"""File of each clip."""


@dataclass(frozen=True)
class Images:
    """The images of one camera, cut out around the person.

    Attributes:
        files: WebP files, of the frames 0, `IMAGE_STEP`, 2 `IMAGE_STEP`, ...
        corner: (2,) of the image in the pixels of the camera, left and top.
        scale: pixels of the image for each pixel of the camera.
        size: width and height of the image in its own pixels.
    """

    files: tuple[bytes, ...]
    corner: Array
    scale: float
    size: tuple[int, int]

    def to_image(self, pixels: Any) -> Array:
        """Return pixels of the camera (..., 2) as pixels of the image."""
        inside: Array = (np.asarray(pixels, np.float64) - self.corner) * self.scale
        return inside


@dataclass(frozen=True)
class Clip:
    """Detections with ground truth, and images.

    Attributes:
        session: the world has z up, its unit is mm, and the floor is at z = 0.
        images: of each view of the session.
        layout: of the detections.
    """

    session: Session
    images: tuple[Images, ...]
    layout: KeypointLayout = BODY25B


def read_clip(trial: str = BALANCING) -> Clip:
    """Return a clip of the package.

    Args:
        trial: a key of `FILES`.
    """
    with (files("deep_nrsfm_ros.data") / FILES[trial]).open("rb") as file, np.load(file) as arrays:
        return _clip(arrays)


def write_clip(path: Path, clip: Clip) -> None:
    """Write a clip as one file."""
    views, images = clip.session.views, clip.images
    cameras = [view.camera for view in views]
    files = [file for each in images for file in each.files]
    arrays: dict[str, Any] = {
        "names": [camera.name for camera in cameras],
        "matrices": [camera.matrix for camera in cameras],
        "distortions": [camera.distortion for camera in cameras],
        "rotations": [camera.rotation for camera in cameras],
        "translations": [camera.translation for camera in cameras],
        "sizes": [camera.size for camera in cameras],
        "points": np.stack([view.points for view in views]),
        "confidence": np.stack([view.confidence for view in views]),
        "delays": [view.delay for view in views],
        "truth": np.stack([view.truth for view in views]).astype(np.float32),
        "world": clip.session.world.astype(np.float32),
        "pixels": [clip.session.pixels, clip.session.pixels_given],
        "corners": [each.corner for each in images],
        "scales": [each.scale for each in images],
        "image_sizes": [each.size for each in images],
        "images": np.frombuffer(b"".join(files), np.uint8),
        "image_lengths": np.reshape([len(file) for file in files], (len(images), -1)),
        "layout": clip.layout.name,
    }
    np.savez_compressed(path, **arrays)


def _clip(arrays: Any) -> Clip:
    """Return the clip of a file's arrays."""
    views = []
    for i, name in enumerate(arrays["names"].tolist()):
        width, height = arrays["sizes"][i].tolist()
        matrix, distortion, rotation, translation = (
            arrays[key][i] for key in ("matrices", "distortions", "rotations", "translations")
        )
        camera = Camera(name, matrix, distortion, rotation, translation, (width, height))
        points, confidence = arrays["points"][i], arrays["confidence"][i]
        truth = arrays["truth"][i].astype(np.float64)
        views.append(View(camera, points, confidence, float(arrays["delays"][i]), truth))
    (mean, median), (mean_given, median_given) = arrays["pixels"].tolist()
    session = Session(
        tuple(views),
        arrays["world"].astype(np.float64),
        (mean, median),
        (mean_given, median_given),
    )
    raw, lengths = arrays["images"].tobytes(), arrays["image_lengths"]
    ends = np.cumsum(lengths.ravel())
    files = [raw[end - n : end] for end, n in zip(ends.tolist(), lengths.flat, strict=True)]
    count = lengths.shape[1]
    images = []
    for i in range(len(views)):
        width, height = arrays["image_sizes"][i].tolist()
        own = tuple(files[i * count : (i + 1) * count])
        images.append(
            Images(own, arrays["corners"][i], float(arrays["scales"][i]), (width, height))
        )
    layout = preset(str(arrays["layout"])) if "layout" in arrays else BODY25B
    return Clip(session, tuple(images), layout)
