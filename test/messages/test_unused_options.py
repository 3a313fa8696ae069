# SPDX-License-Identifier: Apache-2.0
"""Options that cannot have an effect are warned of."""

from __future__ import annotations

from typing import Any

import pytest

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.lifting.options import GravityOptions, HistoryOptions, LiftingOptions
from deep_nrsfm_ros.lifting.smoothing import SmoothingOptions
from deep_nrsfm_ros.messages.options import InputOptions
from deep_nrsfm_ros.messages.unused_options import unused_gravity, unused_height, unused_options

DEFAULTS = (InputOptions(), LiftingOptions(), SmoothingOptions())


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (InputOptions(image_width=1280), "image_width is 1280 and has no effect without image_h"),
        (InputOptions(image_height=720), "image_height is 720 and has no effect without image_w"),
        (SmoothingOptions(beta=2.0), "smoothing.beta is 2 and has no effect, since smoothing.ena"),
        (LiftingOptions(correction="none", noise=0.1), "noise is 0.1 and has no effect, since cor"),
    ],
)
def test_an_option_without_effect_is_warned_of(options: Any, expected: str) -> None:
    given: Any = [options if type(options) is type(other) else other for other in DEFAULTS]
    assert expected in " ".join(unused_options(*given).values())


def test_options_with_an_effect_are_not_warned_of() -> None:
    inputs = InputOptions(image_width=1280, image_height=720)
    assert not unused_options(inputs, LiftingOptions(noise=0.1), SmoothingOptions(True, beta=2.0))
    assert not unused_options(*DEFAULTS)


class Sources:
    """As the node's parameters."""

    imu, frame = "/imu", ""


def test_gravity_without_effect_is_warned_of() -> None:
    level, layout = GravityOptions((0, -1.0, 0)), KeypointLayout("chair", ("a", "b", "c", "d"))
    warnings = unused_gravity(level, Sources(), LiftingOptions(), layout)
    assert list(warnings) == ["gravity.up", "gravity.imu"]
    assert "'chair' names no top and bottom" in warnings["gravity.imu"]
    warnings = unused_gravity(level, Sources(), LiftingOptions(correction="none"), HUMAN17)
    assert "no effect, since correction is 'none'" in warnings["gravity.up"]
    assert not unused_gravity(level, Sources(), LiftingOptions(), HUMAN17)


def test_the_height_of_people_says_nothing_of_other_objects() -> None:
    lifting, chair = LiftingOptions(person_height=1.8), KeypointLayout("chair", ("a", "b"))
    defaults = (InputOptions(), lifting, SmoothingOptions(), HistoryOptions())
    (warning,) = unused_options(*defaults, chair).values()
    assert "person_height is 1.8" in warning and "'chair'" in warning
    assert not unused_options(*defaults, HUMAN17) and not unused_options(*defaults)
    both = LiftingOptions(person_height=1.8, reference_length=0.5)
    (warning,) = unused_options(InputOptions(), both, *defaults[2:], HUMAN17).values()
    assert "since reference_length is 0.5" in warning


class NoSources:
    """As the node's parameters by default."""

    imu, frame = "", ""


def test_a_height_above_the_floor_without_gravity_is_warned_of() -> None:
    unknown, level = GravityOptions(), GravityOptions((0, -1.0, 0))
    (warning,) = unused_height(1.4, unknown, NoSources(), "").values()
    assert "camera_height is 1.4" in warning and "gravity.imu" in warning
    assert not unused_height(1.4, level, NoSources(), "")
    assert not unused_height(1.4, unknown, Sources(), "")
    assert not unused_height(1.4, unknown, NoSources(), "map")
