"""Lift a person of the package's clip over time, and save 3D and confidence: files, without ROS."""

import numpy as np

from deep_nrsfm_ros import Lifter, load_model
from deep_nrsfm_ros.data.clip import read_clip

view = read_clip().session.views[0]
lifter = Lifter(load_model("human"), layout="body25b")
lifted = lifter(view.points, view.confidence)  # (100, 25, 2) pixels, (100, 25)
np.savez("lifted.npz", shapes=lifted.shapes, confidence=lifted.confidence)
print(f"{len(lifted.shapes)} frames, mean confidence {lifted.confidence.mean():.2f}: lifted.npz")
