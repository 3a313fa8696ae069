# SPDX-License-Identifier: Apache-2.0
"""Lift a video with the camera's intrinsics and over time, and measure it against the truth."""

import numpy as np

from deep_nrsfm_ros import Lifter, VideoLifter
from deep_nrsfm_ros.data.clip import read_clip
from deep_nrsfm_ros.data.pose2sim import JOINTS
from deep_nrsfm_ros.nrsfm.metrics import camera_errors

view = read_clip().session.views[0]  # a person, 100 frames at 60 Hz; put your arrays here
points, confidence = view.points, view.confidence  # (100, 25, 2) pixels, (100, 25)
camera = view.camera.intrinsics  # Intrinsics((fx, fy), (cx, cy), (k1, k2, p1, p2))
truth = view.truth  # (100, 12, 3) mm in the camera's axes; NaN where unknown

lifter = Lifter("human", layout="body25b")
video = VideoLifter(lifter, camera)
shapes = []
for i in range(len(points)):
    lifted = video(points[i], confidence[i], seconds=i / 60)
    shapes.append(lifted.shapes[0])  # of the only person, video.identities[0]; NaN: not lifted

names = lifter.model.layout.keypoints
joints = np.array(shapes)[:, [names.index(name) for name in JOINTS]]
errors = camera_errors(joints, truth)
print(f"{errors.aligned:.1f} mm after alignment, {errors.in_camera:.1f} mm in the camera's axes")
place = 1000 * joints.mean(1) - truth.mean(1)
print(f"its place is off by {np.nanmedian(np.linalg.norm(place, axis=1)):.0f} mm")
