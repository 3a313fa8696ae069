"""How far a training is, how good, and how long it will take."""

from __future__ import annotations

import time
from typing import NamedTuple

from deep_nrsfm_ros.nrsfm.network import coherence
from deep_nrsfm_ros.training.trainer import Trainer


class Progress(NamedTuple):
    """State of a training, means over the steps since the last report."""

    step: int
    steps: int
    seed: int
    loss: float  # relative reprojection error
    cycle_error: float  # relative error of shapes reconstructed again from another camera
    coherence: float  # of the final dictionary
    seconds_left: float


class Clock:
    """When to report, how long is left, and how much of the time there is is gone."""

    def __init__(self, steps: int, limit: float, every_seconds: float = 5.0) -> None:
        """Take the limit in seconds; 0 is none."""
        self.steps, self.limit, self.every = steps, limit, every_seconds
        self.start, self.before = time.monotonic(), 0.0
        self.restart(0)

    def restart(self, step: int) -> None:
        """Take the pace from this step on."""
        self.began = self.reported = time.monotonic()
        self.first = step

    def seconds(self) -> float:
        """Return how long the training has taken, what it goes on with included."""
        return self.before + time.monotonic() - self.start

    def gone(self) -> float:
        """Return the share of the time that is gone; 0 without a limit."""
        return self.seconds() / self.limit if self.limit else 0.0

    def due(self) -> bool:
        """Tell whether a report is due."""
        return time.monotonic() - self.reported >= self.every

    def progress(self, trainer: Trainer) -> Progress:
        """Return the report of a trainer; the next one is due a while after it."""
        self.reported = time.monotonic()
        pace = (self.reported - self.began) / max(trainer.step - self.first, 1)
        loss, cycle = trainer.measure()
        sharpness = coherence(trainer.net.map(lambda w: w.cpu().numpy()))
        left = 0.0 if trainer.ended else pace * (self.steps - trainer.step)
        if self.limit:
            left = min(left, max(self.limit - self.seconds(), 0.0))
        return Progress(trainer.step, self.steps, trainer.seed, loss, cycle, sharpness, left)
