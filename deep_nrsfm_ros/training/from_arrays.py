# SPDX-License-Identifier: Apache-2.0
"""Training from arrays: the whole of the command `train`, from points to a model, in one call."""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deep_nrsfm_ros.configuration import check
from deep_nrsfm_ros.data.curation import Curation, curate
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.hands import as_right_hands, check_side
from deep_nrsfm_ros.data.held_out import MIN_HELD_OUT, MIN_HELD_OUT_ALONE, split
from deep_nrsfm_ros.data.sufficiency import assess_sufficiency
from deep_nrsfm_ros.extras import require_extra
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.observation import Observation, from_arrays, unmasked
from deep_nrsfm_ros.lifting.sanity import confidence_scale, find_origin, looks_normalised
from deep_nrsfm_ros.model_files.find_layout import layout_of
from deep_nrsfm_ros.model_files.matching_model import FROM_NONE, matching_model
from deep_nrsfm_ros.model_files.model_file import Model, check_name, load_model, load_once
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, Recipe
from deep_nrsfm_ros.training.data_check import (
    WRONG_LAYOUT,
    SourceFinding,
    check_objects,
    never_seen,
    sentences,
)
from deep_nrsfm_ros.training.fine_tuning import inherit, start_from
from deep_nrsfm_ros.training.limb_exchange import LimbExchange
from deep_nrsfm_ros.training.same_name import check_not_shipped
from deep_nrsfm_ros.wording import in_python

if TYPE_CHECKING:  # it imports torch
    from deep_nrsfm_ros.training.progress import Progress


_CALLER = 3  # stack level of who calls `train`, above it and its decorator
_MOST_SEQUENCES = 50  # that are checked one by one: each takes up to a second


@in_python()
def train(
    points: ArrayLike,
    confidence: ArrayLike | None = None,
    *,
    layout: KeypointLayout | str | Path | Sequence[str] | NDArray[np.str_],
    object: KeypointLayout | str | Path | Sequence[str] | NDArray[np.str_] | None = None,
    hands: str = "",
    name: str = "trained",
    start: Model | str | Path = "",
    recipe: Recipe | None = None,
    sequence_starts: Sequence[int] | None = (),
    held_out: float = Curation().held_out,
    on_progress: Callable[[Progress], None] = lambda progress: None,
    on_message: Callable[[str], None] = lambda sentence: None,
) -> Model:
    """Train a model on 2D keypoints and return it; `save_model` writes it to a file.

    The data are curated as the command `train` does it: frames with few keypoints, near-duplicates
    and outliers are left out. They are checked as the command checks a file. Warnings about the
    data and the result are Python warnings.

    The model is judged without labels on the last tenth of each sequence, which the training does
    not use (`held_out`), and is compared with the model of the object, where there is one. A model
    of data that looks wrong is doubtful, whatever its figures. `on_message` gets what the judge
    says, and a doubtful model gives a warning. `provenance["judgement"]` of the result is a dict:

    - `verdict`: "better", "as_good", "alone" (no model of the package has these keypoints),
      "unknown" (the model of the object was trained on the held-out frames, and fits them better)
      or "doubtful"; `doubtful`: whether it is the last one.
    - `reason`: the verdict as a sentence, with what would help.
    - `figures`: of the new model by their names, such as `image_error` (on the held-out
      frames), `learned_image_error` (on those of the training), `bone_variation` and
      `mirrored_share`; less is better.
    - `rival`, `rival_figures`: name and figures of the model that it is compared with; there only
      if there is one.
    - `first_look`: True where few steps from random weights have taught too little for use, and
      there is no rival; there only then.
    - `fits_badly`: True where the image error is large (25 % on held-out frames, 20 % on those of
      the training), and there is no rival; there only then.
    - `rival_has_learned_the_frames`: True where the rival was trained on the held-out frames; there
      only then.
    - `faults`: what looks wrong in the data, a sentence each; there only if something does.

    Args:
        points: (f, p, 2) keypoints of f frames, x right and y down, in pixels or another unit that
            is the same for x and y. A keypoint at (0, 0) or with a NaN is missing. Frames without
            any are not used.
        confidence: (f, p) from 0, which is missing, to 1, or booleans of visibility. None: all
            keypoints are visible.
        layout: keypoint layout of the points, as an object, by the name of a preset or a layout
            file ("coco17"), or a list of the keypoints' names.
        object: layout of the model, in the same forms; the points are mapped to it by name. For
            people "human25": such a model has the keypoints of `human`, keeps most of its weights,
            and needs few steps. None: that of the points.
        hands: what is known of recorded hands, which must all be right ones: "right"; "left", which
            are mirrored; "palms" where each shows its palm, so that left ones are seen and
            mirrored. "": nothing.
        name: name of the model, not one of the package's: yours would hide it.
        start: model to start from, its name or its file. "" is a model that comes with the package
            and has most keypoints of the layout, if there is one; "none" is random weights.
        recipe: steps, seed and all else of the training; None stands for the defaults: from a
            model of the same keypoints a step for each three frames, at least 100 steps; from
            random weights 30000 steps, which take minutes. `Recipe(steps=3000, seed=1)` is a first
            look.
        sequence_starts: first frames of the recordings, views or people in the points, the frames
            of each in the order of their time: (0, 500) where 500 frames of one camera come first.
            (0,): one recording. () or None: unknown, each quarter of the frames counts as a
            sequence.
        held_out: share of the frames, 0 to 0.5, on which the model is judged: the last ones of each
            sequence, after a gap of half as many that nothing uses. 0, or fewer than 20 frames (50
            where the object has no model): the training uses all, and the model is judged on these.
        on_progress: called every few seconds from the first step on, and at the end.
        on_message: called with a sentence when work of up to minutes begins before the first step,
            such as the factorisations of at most `Recipe.few_frames` frames, and at the end with
            what the judge says; `print` shows it.

    Raises:
        MissingExtraError: torch is not installed.
        ValueError: the arrays do not fit each other or the layout, the keypoints are clearly in
            another layout, or a model cannot be learned from them; or the name is that of a model
            that comes with the package.
    """
    require_extra("train", "training")
    from deep_nrsfm_ros.training.finish import finish
    from deep_nrsfm_ros.training.judge import judge
    from deep_nrsfm_ros.training.loop import Callbacks
    from deep_nrsfm_ros.training.loop import train as run
    from deep_nrsfm_ros.training.setup import Setup

    check_name("name", name)
    check_not_shipped("name", name)
    check_side("hands", hands)
    check(Curation(held_out=held_out))
    layout = layout_of("layout", layout, name)
    seen = from_arrays(points, confidence, layout)
    starts = np.array(() if sequence_starts is None else sequence_starts, np.int64)
    visible = seen.confidence > 0
    data = Dataset(seen.points, visible, layout, "arrays", sequence_starts=starts)
    findings = _findings(points, confidence, seen, data)
    if object is not None:
        layout = layout_of("object", object, name)
        mapped, weight = KeypointMap(data.layout, layout)(seen.points, seen.confidence)
        data = Dataset(mapped, weight > 0, layout, "arrays", sequence_starts=starts)
    if (is_seen := seen.confidence.any(1)).any():  # a frame that shows nothing is padding
        data = data if is_seen.all() else data[np.flatnonzero(is_seen)]
    if hands:
        data = as_right_hands(data, hands)
    curated = curate(data)
    origin = _origin(start, layout)
    sufficiency = assess_sufficiency(
        curated.dataset,
        has_start=origin is not None,
        near_duplicates=curated.near_duplicates,
    )
    if sufficiency.refusal:
        raise ValueError(f"a model cannot be learned from this: {sufficiency.refusal}")
    # A start passes its handedness on to a layout without one.
    missing = layout.warning if layout.handedness or not origin else ""
    unseen = never_seen(curated.dataset, origin)
    found = sentences(findings)
    for warning in (missing, unseen, *found, *curated.warnings, *sufficiency.warnings):
        if warning:
            warnings.warn(warning, stacklevel=_CALLER)
    rival = origin or _shipped(layout)
    frames = split(curated.dataset, held_out, MIN_HELD_OUT if rival else MIN_HELD_OUT_ALONE)
    preset = PRESETS["default"]._replace(recipe=recipe or Recipe())
    setup = Setup(limb_exchange=LimbExchange.of(layout))
    if origin:
        preset = preset._replace(
            architecture=origin.network.architecture, normaliser=origin.normaliser
        )
        setup = dataclasses.replace(setup, start=start_from(origin, layout))
    callbacks = Callbacks(on_progress=on_progress, on_message=on_message)
    trainer = run(frames.training.points, frames.training.visible, preset, setup, callbacks)
    model = finish(trainer, name, layout, curated.dataset.source)
    if origin:
        model = inherit(model, origin)
    judgement = judge(frames, model, rival, findings)
    on_message(judgement.brief)
    if judgement.doubtful:
        warnings.warn(judgement.brief, stacklevel=_CALLER)
    date = time.strftime("%Y-%m-%d", time.gmtime())
    model.provenance.update(date=date, judgement=judgement.record())
    return model


def _findings(
    points: ArrayLike, confidence: ArrayLike | None, seen: Observation, data: Dataset
) -> list[SourceFinding]:
    """Return what looks wrong in the arrays; each of several sequences is checked by itself.

    Args:
        points: as given.
        confidence: as given.
        seen: the observation of them.
        data: the dataset of it.

    Raises:
        ValueError: another layout fits clearly better.
    """
    xy = unmasked(points, np.nan)
    given = np.ones(xy.shape[:-1])
    if confidence is not None:
        given = unmasked(confidence, 0).astype(float)
    whole = confidence_scale(given) + find_origin(xy, given)
    findings = [SourceFinding("", finding) for finding in whole]
    # Only fractions of an image's size have units of their own for x and y.
    is_normalised = looks_normalised(seen.points, seen.confidence > 0)
    starts = data.sequence_starts if len(data.sequence_starts) <= _MOST_SEQUENCES else ()
    for first, end in pairwise([*(starts if len(starts) else [0]), len(data)]):
        part = f"frames {first} to {end - 1}" if len(starts) > 1 else ""
        rows = slice(first, end)
        for finding in check_objects(
            seen.points[rows], seen.confidence[rows], data.layout, data.layout
        ):
            if finding.code == WRONG_LAYOUT:
                raise ValueError(f"{part}: {finding}" if part else str(finding))
            if finding.code != "normalised" or is_normalised:
                findings.append(SourceFinding(part, finding))
    return findings


def _origin(start: Model | str | Path, layout: KeypointLayout) -> Model | None:
    """Return the model to start from; None for random weights."""
    if isinstance(start, Model):
        return start
    if start == FROM_NONE:
        return None
    if start:
        return load_model(start)
    return _shipped(layout)


def _shipped(layout: KeypointLayout) -> Model | None:
    """Return the model of the package that has the keypoints of a layout, if there is one."""
    known = matching_model(layout)
    return load_once(known) if known else None
