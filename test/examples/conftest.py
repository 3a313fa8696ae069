# SPDX-License-Identifier: Apache-2.0
"""The examples with stand-ins for MediaPipe and OpenCV, which the environment need not have."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
STAND_INS = Path(__file__).parent / "stand_ins"


@pytest.fixture
def stand_ins(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let processes that the test starts find the examples, and the stand-ins before all else."""
    monkeypatch.setenv("PYTHONPATH", f"{STAND_INS}{os.pathsep}{ROOT}")


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Return the module of the detector, imported with the stand-ins."""
    names = ("cv2", "mediapipe", "deep_nrsfm_ros.node.mediapipe_detector")
    for name in names:
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.syspath_prepend(STAND_INS)
    yield importlib.import_module(names[-1])
    for name in names:
        sys.modules.pop(name, None)
