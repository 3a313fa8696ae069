# SPDX-License-Identifier: Apache-2.0
"""What looks wrong in the data of a training, by the check that `lift` and the lifter use."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.layout_fit import MAX_OBJECTS, better_layout, fit_layouts
from deep_nrsfm_ros.lifting.lifter import Lifter, lift_all
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.lifting.sanity import Finding, Size, check, find_sentinel, pose, quality
from deep_nrsfm_ros.model_files.model_file import Model, load_model
from deep_nrsfm_ros.training.layout_choice import PEOPLE, in_words

Floats = NDArray[np.floating[Any]]

WRONG_LAYOUT = "layout"
"""Code of the finding that another layout fits clearly better: no model can come of such data."""
SERIOUS = {
    *("poor-fit", "orientation", "handedness", "normalised", "sentinel", "origin"),
    *("confidence-scale", "misspelt", "one-side", "unnamed", "depth"),
    *("incomplete", "mixed-hands"),
}
"""Codes of the findings that make a model doubtful: it learns what is wrong in its data."""

_PERSON = {"left_hip", "left_ankle", "left_shoulder"}  # keypoints of every layout of people
_MOST_CHECKED = 100_000  # frames
_NUMBER = re.compile(r"[-+]?\d[\d.,e+]*")
_COUNTS = re.compile(r"(?<![\d.])(\d+)(%?) of (the )?(\d+)(?![\d.]*\d)")
_SAME_POINT = 1e-3  # of the size of the data, within which two files have the same keypoint
_COMPARED = 200  # frames


class SourceFinding(NamedTuple):
    """Something that looks wrong in one source of the data.

    Attributes:
        source: name of the bag or file, or of a part of an array; "" for all data.
        finding: what looks wrong in it.
    """

    source: str
    finding: Finding


def check_objects(
    points: Floats,
    confidence: Floats | NDArray[np.bool_],
    layout: KeypointLayout,
    target: KeypointLayout,
    image_size: Size | None = None,
    *,
    may_be_another: bool = True,
) -> list[Finding]:
    """Return what looks wrong in the objects of one bag, file or array.

    People are lifted, to see whether they fit a model of people.

    Args:
        points: (n, q, 2); 0 where missing.
        confidence: (n, q) from 0, where missing, to 1, or whether they are visible.
        layout: in which the points are said to be.
        target: of the object that is trained on.
        image_size: width and height of the image in pixels; None: unknown.
        may_be_another: whether the points may be in another layout than it is said.
    """
    step = max(1, len(points) // _MOST_CHECKED)
    points, confidence = points[::step], np.asarray(confidence[::step], np.float32)
    # A training uses the size for fractions alone: pixels may be of an image of another size.
    findings = check(points, confidence, None, image_size, is_normalised=True)
    if not set(target.keypoints) >= _PERSON or not len(points):
        return findings
    model = load_model(PEOPLE)
    try:
        to_model = KeypointMap(layout, model.layout)
    except ValueError:  # it shares too few keypoints with the model
        return findings
    if sentinel := find_sentinel(points, confidence > 0):
        confidence = np.where((points == sentinel[0]).all(-1), np.float32(0), confidence)
    chosen = np.linspace(0, len(points) - 1, min(len(points), MAX_OBJECTS)).astype(int)
    lifter = Lifter(model, LiftingOptions(correction="none", test_time_rotations=1))
    sample = np.asarray(points[chosen], np.float32), np.asarray(confidence[chosen], np.float32)
    lifted = lift_all(lifter.lift, *to_model(*sample))
    # Confidence is not rated: a model is trained where the one at hand does not suffice.
    poor = [f for f in quality(lifted.residual, lifted.object_confidence) if f.code == "poor-fit"]
    if poor and may_be_another:
        fits = fit_layouts(*sample, model, [layout])
        better = better_layout(fits, layout, float(np.nanmedian(lifted.residual)))
        poor = [better] if better else poor
    if poor and any(finding.code == "normalised" for finding in findings):
        poor = [finding for finding in poor if finding.code == WRONG_LAYOUT]  # that is its cause
    return findings + (poor or pose(lifted.rotations, sample[1], layout))


def serious(findings: Iterable[SourceFinding]) -> list[SourceFinding]:
    """Return the findings that make a model doubtful."""
    return [each for each in findings if each.finding.code in SERIOUS]


def sentences(findings: Iterable[SourceFinding], *, is_brief: bool = False) -> list[str]:
    """Return a sentence for each kind of finding, with the sources in which it was found.

    Of findings that differ in their numbers alone, counts such as "5 of 60" and "8% of the 60" are
    summed, and other numbers are those of the first one.

    Args:
        findings: of any sources.
        is_brief: leave the remedies out.
    """
    kinds: dict[str, list[SourceFinding]] = {}
    for each in findings:
        kinds.setdefault(_NUMBER.sub("#", str(each.finding)), []).append(each)
    said = []
    for kind in kinds.values():
        sources = in_words(dict.fromkeys(each.source for each in kind if each.source))
        found = [each.finding for each in kind]
        text = _summed([each.symptom if is_brief else str(each) for each in found])
        said.append(f"{sources}: {text}" if sources else text)
    return said


def _summed(texts: list[str]) -> str:
    """Return the first of texts that differ in their numbers alone, with the sum of all counts."""
    found = [list(_COUNTS.finditer(text)) for text in texts]
    if len(texts) < 2 or len({len(each) for each in found}) > 1:
        return texts[0]
    parts, at = list[str](), 0
    for same in zip(*found, strict=True):
        totals = [int(each[4]) for each in same]
        parts.append(texts[0][at : same[0].start()])
        if same[0][2]:
            counts = sum(int(each[1]) * n for each, n in zip(same, totals, strict=True))
            parts.append(f"{counts / max(sum(totals), 1):.0f}%")
        else:
            parts.append(str(sum(int(each[1]) for each in same)))
        parts.append(f" of {same[0][3] or ''}{sum(totals)}")
        at = same[0].end()
    return "".join([*parts, texts[0][at:]])


def never_seen(dataset: Dataset, start: Model | None = None) -> str:
    """Return a sentence on the keypoints that no frame shows; "" if each is shown.

    Args:
        dataset: the frames of a training.
        start: the model that it starts from, whose guesses remain; None: it has none.
    """
    times_visible = zip(dataset.layout.keypoints, dataset.visible.sum(0), strict=True)
    missing = [name for name, times in times_visible if not times]
    as_start = f", as {start.name!r} does" if start else ""
    sentence = f"no frame shows {', '.join(missing)}: the model will only guess them{as_start}"
    return sentence if missing else ""


def is_copy(dataset: Dataset, other: Dataset) -> bool:
    """Return whether two datasets have the same keypoints, apart from rounding."""
    if len(dataset) != len(other) or not len(dataset):
        return False
    rows = np.linspace(0, len(dataset) - 1, min(len(dataset), _COMPARED)).astype(int)
    first, second = dataset.points[rows], other.points[rows]
    one, two = dataset.visible[rows], other.visible[rows]
    both = one & two
    if 2 * both.sum() < max(one.sum(), two.sum()) or not both.any():
        return False
    size = np.ptp(first[both], axis=0).max()
    return bool(np.abs(first - second)[both].max() <= _SAME_POINT * size)
