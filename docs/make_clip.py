# SPDX-License-Identifier: Apache-2.0
"""Make the clips that come with the package from the wheel of Pose2Sim.

    python -m docs.make_clip     # after `make demo-live`, which installs OpenCV and MediaPipe

Writes `clip.npz` and `clip_standing.npz` in `deep_nrsfm_ros/data`; the wheel is fetched to
`.cache`, MediaPipe's results are kept in `runs/benchmarks`.
"""

from __future__ import annotations

import io
import tempfile
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from benchmarks.data.pose2sim_scenes import scenes
from deep_nrsfm_ros.data.clip import (
    BALANCING,
    FILES,
    IMAGE_STEP,
    STANDING,
    Clip,
    Images,
    write_clip,
)
from deep_nrsfm_ros.data.pose2sim import (
    Session,
    View,
    extract_videos,
    fetch_wheel,
    read_session,
)
from deep_nrsfm_ros.layouts.presets import BODY25B, MEDIAPIPE33

_ASPECT = 0.8  # width / height of the images
_HEIGHT = 340  # pixels of the images
_MARGIN = 0.07  # of the height, around the person
_QUALITY = 40  # of WebP


def cut_out(view: View, video: Path) -> Images:
    """Return the images of one camera around the person, who stays in the picture throughout."""
    points = view.points[view.confidence > 0.2]
    low, high = np.percentile(points, (0.5, 99.5), 0)
    middle = (low + high) / 2
    height = max(high[1] - low[1], (high[0] - low[0]) / _ASPECT) * (1 + 2 * _MARGIN)
    scale, size = _HEIGHT / height, (round(_HEIGHT * _ASPECT), _HEIGHT)
    capture, files, number = cv2.VideoCapture(str(video)), [], 0
    whole = [capture.get(key) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
    extent = np.array(size) / scale
    corner = np.clip(middle - extent / 2, 0, np.maximum(np.array(whole) - extent, 0))
    while (read := capture.read())[0]:
        if number % IMAGE_STEP == 0 and number < len(view.points):
            image = Image.fromarray(cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB))
            box = (*corner, *(corner + extent))
            corners = (box[0], box[1], box[0], box[3], box[2], box[3], box[2], box[1])
            part = image.transform(
                (4 * size[0], 4 * size[1]), Image.Transform.QUAD, corners, Image.Resampling.BICUBIC
            ).resize(size, Image.Resampling.LANCZOS)
            buffer = io.BytesIO()
            part.save(buffer, "WEBP", quality=_QUALITY, method=6)
            files.append(buffer.getvalue())
        number += 1
    return Images(tuple(files), corner.astype(np.float64), float(scale), size)


def standing(moving: Session) -> Session:
    """Return the person who stands: MediaPipe's keypoints, and ground truth made of them."""
    _, still, (_, pixels) = scenes(Path("runs/benchmarks"))
    views = tuple(
        View(
            view.camera,
            np.nan_to_num(scene.mediapipe.points).astype(np.float32),
            scene.mediapipe.confidence.astype(np.float32),
            0.0,
            scene.truth,
        )
        for view, scene in zip(moving.views, still, strict=True)
    )
    camera, truth = views[0].camera, views[0].truth
    world = (truth - camera.translation) @ camera.rotation
    return Session(views, world, (pixels, pixels), moving.pixels_given)


def main() -> None:
    """Write the files."""
    wheel = fetch_wheel(Path(".cache"))
    moving = read_session(wheel)
    for trial, video, session, layout in (
        (BALANCING, "Balancing", moving, BODY25B),
        (STANDING, "Static", standing(moving), MEDIAPIPE33),
    ):
        with tempfile.TemporaryDirectory() as folder:
            videos = extract_videos(wheel, video, Path(folder))
            images = tuple(cut_out(view, videos[view.camera.name]) for view in session.views)
        path = Path("deep_nrsfm_ros/data") / FILES[trial]
        write_clip(path, Clip(session, images, layout))
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
