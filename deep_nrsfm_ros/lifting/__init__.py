# SPDX-License-Identifier: Apache-2.0
"""Lifting: from 2D keypoints to 3D shapes and cameras with a trained model; no torch, no ROS."""
