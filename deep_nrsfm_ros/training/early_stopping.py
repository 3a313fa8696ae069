# SPDX-License-Identifier: Apache-2.0
"""When a training ends before its last step: its time is up, or its quality no longer improves."""

from __future__ import annotations

from deep_nrsfm_ros.training.limits import Limits


def time_is_up(step: int, time_fraction: float, budget: float = 1.0) -> bool:
    """Return whether a training has used its time.

    The first step is always taken, so that there is a result to compare or to keep.

    Args:
        step: steps taken so far.
        time_fraction: elapsed fraction of the time limit; 0 without a limit.
        budget: fraction of the time limit at which this stage ends: 1 for the training, less while
            seeds are screened.
    """
    return step > 0 and time_fraction >= budget


def patience_exceeded(limits: Limits, progress: float, last_improvement: float) -> bool:
    """Return whether the quality has not improved for longer than the patience.

    Args:
        limits: with the patience, a fraction of the training; 0 = never exceeded.
        progress: of the training, in [0, 1].
        last_improvement: progress at the last improvement.
    """
    return 0 < limits.patience < progress - last_improvement


def end_reason(*, all_steps: bool, no_improvement: bool) -> str:
    """Return the sentence that says why a training is complete."""
    if no_improvement:
        return "its quality no longer improved"
    return "all steps were taken" if all_steps else "its time was up"
