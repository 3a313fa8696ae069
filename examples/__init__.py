"""Examples: what to put before the lifter."""
