# SPDX-License-Identifier: Apache-2.0
"""Cells that are no numbers are counted; times are read as texts too."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.data.formats.builder import DetectionsBuilder, KeypointFileError
from deep_nrsfm_ros.data.formats.cells import Numbers, stamp_of_text, whole_or_fraction
from deep_nrsfm_ros.data.read_options import ReadOptions


def test_what_is_missing_is_no_error() -> None:
    numbers = Numbers()
    values = numbers.row(["1", "", "NA", "nan", "None", "-", "True", "2.5e1"], 2)
    np.testing.assert_array_equal(values, [1, *[np.nan] * 5, 1, 25])
    builder = DetectionsBuilder(ReadOptions())
    numbers.say(builder)
    assert not builder.warnings and not numbers.wrong


def said(wrong: int, sound: int) -> DetectionsBuilder:
    """Return a builder that was told of cells that are no numbers."""
    numbers, builder = Numbers(), DetectionsBuilder(ReadOptions())
    numbers.row(["1"] * sound, 2)
    numbers.row(["1.088,500"] * wrong, 7)
    numbers.say(builder)
    return builder


def test_cells_that_are_no_numbers_are_named() -> None:
    sentence = "1 of 200 cells are no numbers, such as '1.088,500' in line 7"
    assert said(1, 199).warnings[0].startswith(sentence)
    builder = said(4, 196)
    builder.frame(0)
    (finding,) = builder.detections("").findings
    assert finding.code == "cells" and "4 of 200 cells are no numbers" in finding.message
    with pytest.raises(KeypointFileError, match="separators of thousands"):
        said(6, 4)


@pytest.mark.parametrize(
    ("text", "stamp"),
    [
        *(("2024-05-01T10:00:00.3Z", 1714557600_300000000), ("10:00:00.3", 36000_300000000)),
        ("2024-05-01 10:00:00,300", 1714557600_300000000),
        ("2024/05/01 12:00:00.123456789+02:00", 1714557600_123456789),
        *(("2024-05-01T10:00", 1714557600_000000000), ("1969-12-31T23:59:59Z", -1_000000000)),
        *(("00:01.25", 1_250000000), ("abc", None), ("2024-05-01", None), ("12:30", None)),
        *(("10.5", None), ("", None)),
    ],
)
def test_times_as_texts(text: str, stamp: int | None) -> None:
    assert stamp_of_text(text) == stamp


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *(
            ("3", 3),
            ("3.0", 3),
            ("0.1", 0.1),
            ("1e3", 1000),
            ("1714557600000000001", 1714557600000000001),
        ),
        *(("a", None), ("", None), ("nan", None), ("inf", None)),
    ],
)
def test_numbers_of_frames(text: str, value: float | None) -> None:
    found = whole_or_fraction(text)
    assert found == value and type(found) is type(value)
