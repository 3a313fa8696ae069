# SPDX-License-Identifier: Apache-2.0
"""What a file holds and a reader does not use is named; with a known meaning it is a finding."""

from __future__ import annotations

import pytest

from deep_nrsfm_ros.data.formats.unused import find_unused, meaning, unused_sentence


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("frame_no", "the frame"),
        ("Frame #", "the frame"),
        ("img_path", "the frame"),
        ("frameNumber", "the frame"),
        ("timestamp_usec", "the time"),
        ("Time (s)", "the time"),
        ("trackingId", "an identity"),
        ("individual", "an identity"),
        ("nose_prob", "a confidence"),
        ("keypoints_visible", "a confidence"),
        ("bbox", ""),
        ("area", ""),
        ("width", ""),
        ("", ""),
    ],
)
def test_names_are_understood_word_by_word(name: str, what: str) -> None:
    assert meaning(name) == what


def test_only_what_a_reader_could_use_is_a_finding() -> None:
    remedies = {"the frame": "frame", "an identity": "track_id"}
    (finding,) = find_unused("columns", ["frame_no", "area", "pid", "animal"], remedies)
    assert finding.code == "unused"
    assert str(finding) == (
        "not used: columns frame_no (is it the frame?), animal (is it an identity?); call it "
        "'frame', or call it 'track_id' if it is"
    )
    assert not find_unused("columns", ["area", "time"], remedies)


def test_the_sentence_names_some() -> None:
    assert unused_sentence("fields", ["a", "b"]) == "not used: fields a, b"
    assert unused_sentence("fields", list("abcdefgh")) == "not used: fields a, b, c, d, e, f, ..."
