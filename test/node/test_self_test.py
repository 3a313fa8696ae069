# SPDX-License-Identifier: Apache-2.0
"""The doctor's lifter answers over DDS, or says why not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deep_nrsfm_ros.node.self_test import SelfTestError, time_to_first_points


def test_a_lifter_answers(domain: int, models: Path) -> None:
    points = np.random.default_rng(0).uniform(50, 600, (17, 2))
    assert 0 < time_to_first_points(str(models / "person.safetensors"), points, 60)


def test_a_lifter_that_does_not_start_is_quoted(domain: int, models: Path) -> None:
    with pytest.raises(SelfTestError, match="ended with exit code 1.*damaged"):
        time_to_first_points(str(models / "broken.safetensors"), np.ones((17, 2)), 60)
