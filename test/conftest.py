# SPDX-License-Identifier: Apache-2.0
"""Fixtures that several rooms share, each kind in a file of its own."""

import os

# One thread a process: the tests run in as many processes as there are cores, and threads that
# wait for a core spin. It must be set before NumPy or torch is imported.
for _library in ("OMP", "OPENBLAS"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

pytest_plugins = (
    "test.fixtures.synthetic_object",
    "test.fixtures.detector_messages",
    "test.fixtures.pose2sim_session",
)
