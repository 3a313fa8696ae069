"""Messages of detectors: bytes and fields to observations; no ROS import."""
