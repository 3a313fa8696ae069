"""Other methods of non-rigid structure from motion, on the same frames."""
