# SPDX-License-Identifier: Apache-2.0
"""Metres from a person's height."""

from __future__ import annotations

import pytest

from deep_nrsfm_ros.body.person_height import trunk_length


def test_a_person_of_usual_height_has_half_a_metre_from_neck_to_mid_hip() -> None:
    assert trunk_length(1.75) == pytest.approx(0.5)
    assert trunk_length(3.5) == pytest.approx(1.0)
