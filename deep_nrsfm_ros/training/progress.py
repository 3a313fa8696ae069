# SPDX-License-Identifier: Apache-2.0
"""Progress of a training: step, errors and remaining time."""

from __future__ import annotations

import time
from typing import NamedTuple

from deep_nrsfm_ros.nrsfm.network import coherence
from deep_nrsfm_ros.training.trainer import Trainer

_FIRST_REPORT = 1.0  # s


class Progress(NamedTuple):
    """A report on a training."""

    step: int
    steps: int  # at which the training ends; with a time limit, by its present pace
    seed: int
    loss: float  # relative reprojection error
    cycle_error: float  # relative error of shapes reconstructed again from another camera
    coherence: float  # of the final dictionary
    seconds_left: float


class Clock:
    """Times the reports of a training and its time limit."""

    def __init__(self, steps: int, limit: float, every_seconds: float = 5.0) -> None:
        """Start the clock.

        Args:
            steps: of the whole training.
            limit: seconds, 0 = no limit.
            every_seconds: from one report to the next; the first one is due after a second.
        """
        self.steps, self.limit, self.every = steps, limit, every_seconds
        self.start, self.earlier_seconds = time.monotonic(), 0.0
        self.reported = self.start + _FIRST_REPORT - every_seconds

    def begin_steps(self) -> None:
        """Count the time until now as that of earlier work, not of steps."""
        now = time.monotonic()
        self.earlier_seconds += now - self.start
        self.start = now

    def seconds(self) -> float:
        """Return the seconds that the training has taken, resumed runs included."""
        return self.earlier_seconds + time.monotonic() - self.start

    def elapsed_fraction(self) -> float:
        """Return the fraction of the time limit that has elapsed; 0 without a limit."""
        return self.seconds() / self.limit if self.limit else 0.0

    def due(self) -> bool:
        """Return whether a report is due."""
        return time.monotonic() - self.reported >= self.every

    def progress(self, trainer: Trainer, iterations: int) -> Progress:
        """Return the report of a trainer, and count the time to the next one from here.

        Args:
            trainer: at its present step.
            iterations: steps of all seeds since the start of the clock, which give the pace.
        """
        self.reported = time.monotonic()
        pace = (self.reported - self.start) / max(iterations, 1)
        loss, cycle = trainer.measure()
        sharpness = coherence(trainer.net.map(lambda w: w.cpu().numpy()))
        step, steps = trainer.step, self.steps
        left = 0.0 if trainer.end_reason else pace * (steps - step)
        if self.limit:
            left = min(left, max(self.limit - self.seconds(), 0.0))
            steps = min(steps, step + round(left / pace)) if pace else steps
        if trainer.end_reason:
            steps = step
        return Progress(step, steps, trainer.seed, loss, cycle, sharpness, left)
