# SPDX-License-Identifier: Apache-2.0
"""What looks wrong in the data of a training, by the check that `lift` and the lifter use."""

from __future__ import annotations

import dataclasses

import numpy as np

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.layout_fit import MAX_OBJECTS, better_layout, fit_layouts
from deep_nrsfm_ros.lifting.lifter import Lifter, lift_all
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.lifting.sanity import (
    Finding,
    Size,
    check,
    facing,
    orientation,
    quality,
    to_pixels,
)
from deep_nrsfm_ros.model_files.model_file import load_model
from deep_nrsfm_ros.training.layout_choice import PEOPLE
from deep_nrsfm_ros.training.reporter import Reporter

_PERSON = {"left_hip", "left_ankle", "left_shoulder"}  # keypoints of every layout of people
_MOST_CHECKED = 100_000  # frames


def check_dataset(
    dataset: Dataset, source: KeypointLayout, image_size: Size | None, reporter: Reporter
) -> Dataset:
    """Return a dataset in pixels, and report what looks wrong in it.

    Args:
        dataset: as read.
        source: layout in which the detector is said to have given the keypoints.
        image_size: width and height of the image in pixels, by which normalised keypoints are
            multiplied; None: unknown.
        reporter: takes the warnings.
    """
    if image_size is not None:  # else nothing is multiplied
        points = to_pixels(dataset.points, dataset.visible.astype(np.float32), image_size)
        dataset = dataclasses.replace(dataset, points=np.asarray(points, np.float32))
    for finding in _findings(dataset, source, image_size):
        reporter.warn(str(finding))
    return dataset


def _findings(dataset: Dataset, source: KeypointLayout, image_size: Size | None) -> list[Finding]:
    """Return what looks wrong; people are lifted, to see whether they fit a model of people."""
    step = max(1, len(dataset) // _MOST_CHECKED)
    dataset = dataset[::step]
    confidence = dataset.visible.astype(np.float32)
    findings = check(dataset.points, confidence, None, image_size)
    if not set(dataset.layout.keypoints) >= _PERSON:
        return findings
    model = load_model(PEOPLE)
    chosen = np.linspace(0, len(dataset) - 1, min(len(dataset), MAX_OBJECTS)).astype(int)
    lifter = Lifter(model, LiftingOptions(correction="none", test_time_rotations=1))
    mapped = KeypointMap(dataset.layout, model.layout)(dataset.points[chosen], confidence[chosen])
    lifted = lift_all(lifter.lift, *mapped)
    # Confidence is not rated: a model is trained where the one at hand does not suffice.
    poor = [f for f in quality(lifted.residual, lifted.object_confidence) if f.code == "poor-fit"]
    if poor and dataset.layout.keypoints == source.keypoints:
        fits = fit_layouts(dataset.points, confidence, model, [source])
        better = better_layout(fits, source, float(np.nanmedian(lifted.residual)))
        poor = [better] if better else poor
    if poor:
        return findings + poor
    # A dataset has no confidence, only visible keypoints.
    exchanged = facing(lifted.rotations, confidence[chosen], dataset.layout)
    return findings + orientation(lifted.rotations) + exchanged
