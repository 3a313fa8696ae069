"""Noise, missing keypoints, perspective, confidence, smoothing, corrupted data, long runs."""
