# SPDX-License-Identifier: Apache-2.0
"""Few frames: a network that learns the shapes on which classic factorisations agree.

Below about a thousand frames a network overfits: it explains the images by shapes that are wrong in
depth. Factorisations have fewer parameters and no local minima of this kind. Their shapes, seen by
their own and by random cameras, are what the network must return. The model lifts new frames like
any other.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch

from deep_nrsfm_ros.nrsfm.factorisation.consensus import Consensus, consensus, seconds_at_most
from deep_nrsfm_ros.nrsfm.network import complete, whitening_network
from deep_nrsfm_ros.nrsfm.recipe import Preset
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.trainer import KnownShapes, second_moment
from deep_nrsfm_ros.wording import wording

MIN_STEPS = 2000
"""Steps from which the factorisations are worth their seconds."""
MIN_FRAMES = 10
"""Frames below which cameras and shapes are not determined."""
MIN_VISIBLE = 0.8
"""Share of the keypoints that must be visible; the others are filled in."""
MAX_SPREAD = 0.25
"""Spread of the solutions above which none is believed."""


TIME_SHARE = 2 / 3
"""Share of a time limit that the factorisations take at most; the steps have the rest."""

_REPORT_SECONDS = 30.0


class _TrainingStoppedError(Exception):
    """The training was stopped while it factorised."""


class _TimeIsUpError(Exception):
    """The factorisations have taken their share of the time limit."""


class Factorised(NamedTuple):
    """What the factorisations found.

    Attributes:
        shapes: of the frames; None where a network learns them better.
        minutes_needed: time limit with which they would have come to their end; 0 where they did,
            or never began.
    """

    shapes: Consensus | None = None
    minutes_needed: float = 0.0


def factorise(
    frames: FrameStore,
    preset: Preset,
    should_stop: Callable[[], bool] = lambda: False,
    on_message: Callable[[str], None] = lambda sentence: None,
    most_seconds: float = math.inf,
) -> Factorised:
    """Return the shapes of the frames by factorisation; None where a network learns them better.

    They are None for many or very few frames, short trainings, many missing keypoints, where the
    factorisations disagree, and where there is no time for the first of them.

    Args:
        frames: all frames of the training.
        preset: its recipe says for how many frames to factorise.
        should_stop: called in each iteration; the shapes are None once it is True.
        on_message: called with a sentence before the first factorisation, every half minute, and
            where they are cut short.
        most_seconds: after which they are cut short, and their best shapes until then are returned.
    """
    recipe, p = preset.recipe, frames.points.shape[1]
    if not MIN_FRAMES <= len(frames) <= recipe.few_frames or p < 4 or not recipe.cycle:
        return Factorised()
    if recipe.steps < MIN_STEPS:
        on_message(
            f"fewer than {MIN_STEPS} steps (steps): without the classic factorisations that teach "
            "a network of so few frames, and often mirrored in part for that"
        )
        return Factorised()
    batch = frames.batch(torch.arange(len(frames), device=frames.device))
    points, mask = batch.points.cpu().numpy(), batch.mask.cpu().numpy()
    if mask.mean() < MIN_VISIBLE:
        return Factorised()
    if not mask.all():
        net = whitening_network(second_moment(frames, preset.normaliser))
        centred = points - (points * mask).sum(1, keepdims=True) / mask.sum(1, keepdims=True)
        points, _ = complete(net, centred * mask, mask)
    began = reported = time.monotonic()
    found: list[Consensus] = []

    def before_each() -> None:
        nonlocal reported
        if should_stop():
            raise _TrainingStoppedError
        now = time.monotonic()
        if now - began > most_seconds:
            raise _TimeIsUpError
        if now - reported > _REPORT_SECONDS:
            reported = now
            on_message(f"still factorising after {now - began:.0f} s")

    needed = math.nan
    try:
        needed = seconds_at_most(points, before_each)
        on_message(_beginning(len(points), needed, most_seconds))
        found.append(consensus(points, before_each, found.append))
    except _TrainingStoppedError:
        return Factorised()
    except _TimeIsUpError:
        minutes = _minutes_for(needed if needed > most_seconds else 2 * most_seconds)
        shapes = _believed(found)
        on_message(_cut_short(most_seconds, needed, minutes, anything=shapes is not None))
        return Factorised(shapes, minutes)
    return Factorised(_believed(found))


def _believed(found: Sequence[Consensus]) -> Consensus | None:
    """Return the last of the shapes that were found; None where the solutions disagree."""
    return found[-1] if found and found[-1].spread <= MAX_SPREAD else None


def _minutes_for(seconds: float) -> float:
    """Return the time limit, in half minutes, that leaves the factorisations so many seconds."""
    return math.ceil(seconds / TIME_SHARE / 30) / 2


def _rounded(seconds: float) -> int:
    """Return whole seconds, to a precision that an estimate has."""
    return max(1, round(seconds) if seconds < 20 else round(seconds / 5) * 5)


def minutes_option(minutes: float) -> str:
    """Return a time limit as its option; Python's `train` has none."""
    return wording(
        f"--minutes {minutes:g} (train.minutes)", node=f"train.minutes {minutes:g}", python=""
    )


def _beginning(frames: int, needed: float, most: float) -> str:
    """Return a sentence on factorisations that begin: the seconds they need, and at most have."""
    limit = ""
    if needed > most:
        limit = (
            f"; the time limit leaves them {most:.0f} s, {minutes_option(_minutes_for(needed))} "
            "would be enough"
        )
    return (
        f"classic factorisations of all {frames} frames come first and take up to about "
        f"{_rounded(needed)} s here{limit}; few_frames 0 leaves them out"
    )


def _cut_short(spent: float, needed: float, minutes: float, *, anything: bool) -> str:
    """Return a sentence on factorisations that were cut short, and on what would help."""
    learns = (
        "the network learns the less exact shapes that they found until then"
        if anything
        else "the network learns without them, and may come out mirrored in part"
    )
    known = f"they need up to about {_rounded(needed)} s here: " if needed > spent else ""
    return (
        f"the factorisations are cut short after {spent:.0f} s, to leave time for the network; "
        f"{learns}; {known}give {minutes_option(minutes)}, or leave it out"
    )


class FactorisedShapes:
    """The shapes of a factorisation as known shapes of the cycle loss."""

    def __init__(self, factorisation: Consensus) -> None:
        """Keep shapes (f, p, 3) and cameras M^T (f, 2, 3) of the frames."""
        self.shapes = torch.from_numpy(factorisation.shapes.astype(np.float32))
        self.cameras = torch.from_numpy(factorisation.rotations[:, :2].astype(np.float32))

    def draw(self, size: int, generator: torch.Generator) -> KnownShapes:
        """Return `size` random shapes, with the cameras of the first quarter of them.

        Half of the shapes are those of frames, and half of these have the cameras of their frames.
        Without them a network may tell the frames from what it is taught, and lift them in other
        axes or mirrored. The other shapes lie between those of two frames.

        Args:
            size: number of shapes.
            generator: source of the random numbers.
        """
        first, second = torch.randint(len(self.shapes), (2, size), generator=generator)
        share = torch.rand((size, 1, 1), generator=generator)
        share[: size // 2] = 0
        shapes = torch.lerp(self.shapes[first], self.shapes[second], share)
        return KnownShapes(shapes, self.cameras[first[: size // 4]])
