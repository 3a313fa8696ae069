"""Data: datasets, bags, keypoint files and motion capture; no ROS import."""
