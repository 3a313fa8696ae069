"""Keypoint layouts: which keypoints an object has, in which order, and how they are connected."""
