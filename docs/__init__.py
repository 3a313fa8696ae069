"""Documentation: pages written by hand, and the reference that `generate` writes."""
