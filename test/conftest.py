# SPDX-License-Identifier: Apache-2.0
"""Fixtures that several rooms share, each kind in a file of its own."""

import os
import sys
from pathlib import Path

import pytest

# One thread a process: the tests run in as many processes as there are cores, and threads that
# wait for a core spin. It must be set before NumPy or torch is imported.
for _library in ("OMP", "OPENBLAS"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

# Hundreds of processes of a run import the package and the tests; none but the first compiles them.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

_LONG = (
    "commands/test_demo.py",
    "benchmarks/real/test_train_from_bags.py",
    "node/test_training_faults.py",
    "node/test_training_service.py",
    "examples/test_demo_live.py",
    "training/test_resume.py",
    "node/test_faults.py",
    "node/test_self_check.py",
    "commands/test_train.py",
    "test_package.py",
    "training/test_distributed.py",
    "fuzz/test_files.py",
)
"""The files that take longest. They begin, so that the processes of a run end together."""

pytest_plugins = (
    "test.fixtures.synthetic_object",
    "test.fixtures.detector_messages",
    "test.fixtures.pose2sim_session",
    "test.fixtures.training_program",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests of the files that take longest first; the order is else that of pytest."""
    root = Path(__file__).parent
    order = {root / name: place for place, name in enumerate(_LONG)}
    items.sort(key=lambda item: order.get(item.path, len(order)))
