# SPDX-License-Identifier: Apache-2.0
"""Make the clip that comes with the package from the wheel of Pose2Sim.

    python -m docs.make_clip     # OpenCV decodes the videos: pip install '.[examples,demo]'

Writes `deep_nrsfm_ros/data/clip.npz`; the wheel is fetched to `.cache`.
"""

from __future__ import annotations

import io
import tempfile
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from deep_nrsfm_ros.data.clip import IMAGE_STEP, Clip, Images, write_clip
from deep_nrsfm_ros.data.pose2sim import View, extract_videos, fetch_wheel, read_session

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


def main() -> None:
    """Write the file."""
    wheel = fetch_wheel(Path(".cache"))
    session = read_session(wheel)
    with tempfile.TemporaryDirectory() as folder:
        videos = extract_videos(wheel, "Balancing", Path(folder))
        images = tuple(cut_out(view, videos[view.camera.name]) for view in session.views)
    path = Path("deep_nrsfm_ros/data/clip.npz")
    write_clip(path, Clip(session, images))
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
