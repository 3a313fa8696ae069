"""Latency, training speed and memory, side by side with floors and other ways."""
