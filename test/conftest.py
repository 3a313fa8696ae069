"""Fixtures that several rooms share, each kind in a file of its own."""

pytest_plugins = (
    "test.fixtures.figure",
    "test.fixtures.detector_messages",
    "test.fixtures.session",
)
