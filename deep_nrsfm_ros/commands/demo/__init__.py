"""The demo: real detections of a person, over real DDS, into 3D, and a training on top."""
