# SPDX-License-Identifier: Apache-2.0
"""Lift arrays of 2D keypoints to 3D, in twenty lines: neither ROS nor torch is needed."""

import numpy as np

from deep_nrsfm_ros import Lifter, load_model
from deep_nrsfm_ros.data.clip import read_clip

view = read_clip().session.views[0]  # 100 frames of a person, by OpenPose; put your arrays here
points, confidence = view.points, view.confidence  # (100, 25, 2) pixels, (100, 25)

lifter = Lifter(load_model("human"), layout="body25b")
lifted = lifter(points, confidence)

np.savez("lifted.npz", shapes=lifted.shapes, confidence=lifted.confidence)
frames, keypoints, _ = lifted.shapes.shape
print(f"{frames} frames of {keypoints} keypoints, mean confidence {lifted.confidence.mean():.2f}")
