# SPDX-License-Identifier: Apache-2.0
"""The clip of the package: what it holds, and that it is what the wheel of Pose2Sim holds."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image

from deep_nrsfm_ros.data.clip import IMAGE_STEP, STANDING, read_clip, write_clip
from deep_nrsfm_ros.data.pose2sim import JOINTS
from deep_nrsfm_ros.layouts.presets import MEDIAPIPE33


def test_images_show_the_person() -> None:
    clip = read_clip()
    for view, images in zip(clip.session.views, clip.images, strict=True):
        assert len(images.files) * IMAGE_STEP == len(view.points)
        assert Image.open(io.BytesIO(images.files[7])).size == images.size
        inside = images.to_image(view.points[view.confidence > 0.2])
        assert np.mean((inside > 0) & (inside < images.size)) > 0.99


def test_ground_truth_projects_onto_the_detections() -> None:
    session = read_clip().session
    for view in session.views:
        world = (view.truth - view.camera.translation) @ view.camera.rotation
        pixels = view.camera.project(world)
        off = np.linalg.norm(pixels - view.points[:, 5:17], axis=2)
        assert np.nanmedian(off) < 10
    feet = session.world[:, -2:, 2]
    assert 50 < np.nanmin(feet) < 200  # ankles, mm above the floor


def test_a_clip_is_read_as_it_was_written(tmp_path: Path) -> None:
    clip = read_clip()
    write_clip(tmp_path / "clip.npz", clip)
    with np.load(tmp_path / "clip.npz") as arrays:
        again = arrays["images"].tobytes()
    assert again == b"".join(file for images in clip.images for file in images.files)


def test_a_person_stands_in_the_second_clip() -> None:
    clip = read_clip(STANDING)
    assert clip.layout == MEDIAPIPE33
    limbs = [MEDIAPIPE33.index(joint) for joint in JOINTS]
    for view, images in zip(clip.session.views, clip.images, strict=True):
        assert len(images.files) == -(-len(view.points) // IMAGE_STEP)
        world = (view.truth - view.camera.translation) @ view.camera.rotation
        np.testing.assert_allclose(world, clip.session.world, atol=1)
        off = np.linalg.norm(view.camera.project(world) - view.points[:, limbs], axis=2)
        assert np.nanmedian(off) < 25
    heights = np.nanmedian(clip.session.world[..., 2], 0)
    knees, hips, shoulders = (
        np.mean([heights[JOINTS.index(f"{side}_{part}")] for side in ("left", "right")])
        for part in ("knee", "hip", "shoulder")
    )
    assert 300 < knees < 600 < hips < 1100 < shoulders < 1700  # mm above the floor
