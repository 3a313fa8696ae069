# SPDX-License-Identifier: Apache-2.0
"""Options that bound a training; `early_stopping.py` and the checks of the data apply them."""

from __future__ import annotations

from dataclasses import dataclass

from deep_nrsfm_ros.configuration import described, option


@dataclass(frozen=True)
@described
class Limits:
    """Limits of a training.

    With `minutes` the learning rate follows the clock, so the same seed does not give the same
    model twice.

    `patience` is off by default. The learning rate falls to zero, and most of the gain of the
    second half of a training comes from that fall, so a stretch without improvement before it says
    little. Use 0.2 where steps are plentiful.
    """

    minutes: float = option(
        0.0,
        "minutes of wall time, whatever else keeps the cores busy, after which the training ends; "
        "the learning rate falls to zero by then; factorisations of few frames (few_frames) take "
        "at most two thirds of it; 0 = no limit",
        low=0.0,
        high=100_000.0,
    )
    patience: float = option(
        0.0,
        "share of the steps (or of the time limit) after which a training ends that no longer "
        "improves: its combined error (reprojection and cycle error, which need no labels; "
        "`combined` on ~/training_status) has not fallen by 1 % for so long; 0 = never, 0.2 "
        "typical",
        low=0.0,
        high=1.0,
    )
    max_frames: int = option(
        1_000_000,
        "largest number of frames in the bags; a training with more is refused before they fill "
        "the memory",
        low=10,
        high=1_000_000_000,
        read_only=True,
    )
    free_disk: float = option(
        100.0,
        "MB that must be free on the disk of the models when a training begins; 0 = no check",
        low=0.0,
        high=1e9,
        read_only=True,
    )
    keep_best: bool = option(
        True,
        "keep the weights with the least combined error (reprojection and cycle error) instead of "
        "the last ones",
    )


WHOLE = Limits(keep_best=False)
"""All steps are taken, and the state after the last one is kept."""
