# SPDX-License-Identifier: Apache-2.0
"""Data: datasets, bags, keypoint files and motion capture; no ROS import."""
