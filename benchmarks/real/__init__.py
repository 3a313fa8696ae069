"""Real detections and recorded bags."""
