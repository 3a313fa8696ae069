"""Deep NRSfM for ROS 2: 2D keypoints in, 3D shape and camera out, learned from 2D alone."""

__version__ = "0.1.0"
