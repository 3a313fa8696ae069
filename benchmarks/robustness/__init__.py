# SPDX-License-Identifier: Apache-2.0
"""Noise, missing keypoints, perspective, confidence, smoothing, corrupted data, long runs."""
