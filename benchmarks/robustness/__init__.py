"""Noise, missing points, perspective, long runs and damaged data."""
