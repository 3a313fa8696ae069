"""Fixtures that several rooms share, each kind in a file of its own."""

pytest_plugins = (
    "test.fixtures.synthetic_object",
    "test.fixtures.detector_messages",
    "test.fixtures.pose2sim_session",
)
