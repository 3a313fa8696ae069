"""Real detections with measured truth."""
