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
from collections.abc import Callable

import numpy as np
import torch

from deep_nrsfm_ros.nrsfm.factorisation.consensus import Consensus, consensus
from deep_nrsfm_ros.nrsfm.network import complete, whitening_network
from deep_nrsfm_ros.nrsfm.recipe import Preset
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.trainer import KnownShapes, second_moment

MIN_STEPS = 2000
"""Steps from which the factorisations are worth their seconds."""
MIN_FRAMES = 10
"""Frames below which cameras and shapes are not determined."""
MIN_VISIBLE = 0.8
"""Share of the keypoints that must be visible; the others are filled in."""
MAX_SPREAD = 0.25
"""Spread of the solutions above which none is believed."""


_REPORT_SECONDS = 30.0


class _StoppedError(Exception):
    """The factorisations were stopped; the text says why, "" where the training was stopped."""


def factorise(
    frames: FrameStore,
    preset: Preset,
    should_stop: Callable[[], bool] = lambda: False,
    on_message: Callable[[str], None] = lambda sentence: None,
    most_seconds: float = math.inf,
) -> Consensus | None:
    """Return the shapes of the frames by factorisation; None where a network learns them better.

    They are None for many or very few frames, short trainings, many missing keypoints, where the
    factorisations disagree, and where they take too long.

    Args:
        frames: all frames of the training.
        preset: its recipe says for how many frames to factorise.
        should_stop: called in each iteration; None is returned once it is True.
        on_message: called with a sentence before the first factorisation, every half minute, and
            where they are given up.
        most_seconds: after which they are given up.
    """
    recipe, p = preset.recipe, frames.points.shape[1]
    if not MIN_FRAMES <= len(frames) <= recipe.few_frames or recipe.steps < MIN_STEPS:
        return None
    if p < 4 or not recipe.cycle:
        return None
    batch = frames.batch(torch.arange(len(frames), device=frames.device))
    points, mask = batch.points.cpu().numpy(), batch.mask.cpu().numpy()
    if mask.mean() < MIN_VISIBLE:
        return None
    if not mask.all():
        net = whitening_network(second_moment(frames, preset.normaliser))
        centred = points - (points * mask).sum(1, keepdims=True) / mask.sum(1, keepdims=True)
        points, _ = complete(net, centred * mask, mask)
    on_message(
        f"classic factorisations of all {len(points)} frames come first and may take minutes; "
        "few_frames 0 leaves them out"
    )
    began = reported = time.monotonic()

    def before_each() -> None:
        nonlocal reported
        if should_stop():
            raise _StoppedError
        now = time.monotonic()
        if now - began > most_seconds:
            raise _StoppedError(
                f"the factorisations are given up after {now - began:.0f} s, to leave time for the "
                "network, which learns without them"
            )
        if now - reported > _REPORT_SECONDS:
            reported = now
            on_message(f"still factorising after {now - began:.0f} s")

    try:
        found = consensus(points, before_each)
    except _StoppedError as stopped:
        if reason := str(stopped):
            on_message(reason)
        return None
    return found if found.spread <= MAX_SPREAD else None


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
