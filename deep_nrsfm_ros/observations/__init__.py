"""Everything that turns the outside world into observations: messages, bags, motion capture."""
