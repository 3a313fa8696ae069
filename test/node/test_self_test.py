"""The doctor's lifter answers over DDS, or says why not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deep_nrsfm_ros.node.self_test import LoopbackError, ask_a_lifter


def test_a_lifter_answers(domain: int, models: Path) -> None:
    points = np.random.default_rng(0).uniform(50, 600, (17, 2))
    assert 0 < ask_a_lifter(str(models / "person.safetensors"), points, 60)


def test_a_lifter_that_does_not_start_is_quoted(domain: int, models: Path) -> None:
    with pytest.raises(LoopbackError, match="was not found.*damaged"):
        ask_a_lifter(str(models / "broken.safetensors"), np.ones((17, 2)), 60)
