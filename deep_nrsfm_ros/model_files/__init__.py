"""Model files: their format, the folders where they are found, and names for them."""
