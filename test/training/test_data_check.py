# SPDX-License-Identifier: Apache-2.0
"""Data that looks wrong is said before a training, by the check that `lift` uses."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.data.walking_person import IMAGE, in_layout
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import BODY25, COCO17, HUMAN17
from deep_nrsfm_ros.lifting.sanity import Finding
from deep_nrsfm_ros.training.data_check import (
    SourceFinding,
    check_objects,
    is_copy,
    sentences,
    serious,
)

POINTS, CONFIDENCE = in_layout(COCO17)


def found(
    points: np.ndarray, layout: KeypointLayout = COCO17, target: KeypointLayout | None = None
) -> list[str]:
    return [str(each) for each in check_objects(points, CONFIDENCE, layout, target or layout)]


def test_sound_data_is_taken_without_a_word() -> None:
    assert not found(POINTS) and not found(POINTS, COCO17, HUMAN17)


@pytest.mark.parametrize(
    ("points", "layout", "expected"),
    [
        (POINTS, HUMAN17, "is it coco17?"),
        (POINTS * [1, -1] + [0, 720], COCO17, "upside down"),
        (np.where(np.arange(17)[:, None] == 9, -1, POINTS), COCO17, "exactly (-1, -1)"),
        (POINTS / np.array(IMAGE), COCO17, "they are normalised"),
    ],
)
def test_what_looks_wrong(points: np.ndarray, layout: KeypointLayout, expected: str) -> None:
    (finding,) = found(points, layout)
    assert expected in finding


def test_a_layout_that_fits_is_named_whatever_the_object() -> None:
    assert "is it coco17?" in found(POINTS, HUMAN17, BODY25)[0]
    (poor,) = check_objects(POINTS, CONFIDENCE, HUMAN17, BODY25, may_be_another=False)
    assert poor.code == "poor-fit"


def test_objects_without_names_are_not_taken_for_people() -> None:
    assert not found(POINTS, KeypointLayout.numbered(17))


def test_findings_of_one_kind_are_one_sentence() -> None:
    findings = [
        SourceFinding(f"{i}.npy", Finding("handedness", f"{97 + i}% of the people"))
        for i in range(4)
    ]
    findings.append(SourceFinding("0.npy", Finding("damaged", "it is read up to a damaged place")))
    assert sentences(findings) == [
        "0.npy, 1.npy, 2.npy and 1 more: 97% of the people",
        "0.npy: it is read up to a damaged place",
    ]
    assert serious(findings) == findings[:4]
    assert sentences(findings[4:], is_brief=True) == sentences(findings[4:])
    bare = SourceFinding("", Finding("normalised", "a: b; c"))
    assert sentences([bare], is_brief=True) == ["a"] and sentences([bare]) == ["a: b; c"]


def test_counts_of_findings_of_one_kind_are_summed() -> None:
    texts = ("87 of 2500 visible keypoints lie at (-1, -1): mend it", "13 of 500 {}", "0 of 0 {}")
    rest = texts[0].partition("2500 ")[2]
    findings = [
        SourceFinding(f"{i}.npy", Finding("sentinel", text.format(rest)))
        for i, text in enumerate(texts)
    ]
    assert sentences(findings) == [
        "0.npy, 1.npy, 2.npy: 100 of 3000 visible keypoints lie at (-1, -1): mend it"
    ]
    shares = [
        SourceFinding("", Finding("handedness", f"{share}% of the {n} people whose face is seen"))
        for share, n in ((100, 51), (98, 55))
    ]
    assert sentences(shares) == ["99% of the 106 people whose face is seen"]
    assert sentences(shares, is_brief=True) == sentences(shares)


def test_copies() -> None:
    def dataset(points: np.ndarray, visible: np.ndarray = CONFIDENCE > 0) -> Dataset:
        return Dataset(points.astype(np.float32), visible, COCO17, "test")

    first = dataset(POINTS)
    assert is_copy(first, dataset(POINTS.round(1)))
    assert not is_copy(first, dataset(POINTS + 5)) and not is_copy(first, first[:-1])
    assert not is_copy(first, dataset(POINTS, np.zeros_like(CONFIDENCE, bool)))
