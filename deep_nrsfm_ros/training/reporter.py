# SPDX-License-Identifier: Apache-2.0
"""Reports of a training: progress as a bar or as JSON lines, warnings, and the end."""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Callable
from typing import Any

from tqdm import tqdm

from deep_nrsfm_ros.training.distributed import rank


class CancelledError(Exception):
    """The training was stopped before anything was learned."""


class Reporter:
    """Reports progress as a bar for people, or as JSON lines for a program.

    Attributes:
        as_json: JSON lines on standard output instead of a bar.
        curves: every progress of the training loop, in order.
        warnings: every warning, in order.
    """

    def __init__(self, as_json: bool, should_stop: Callable[[], bool]) -> None:
        """Report nothing until the first progress.

        Args:
            as_json: JSON lines on standard output instead of a bar.
            should_stop: True ends reading and curation, which may take minutes, by
                `CancelledError`.
        """
        self.as_json, self._should_stop = as_json, should_stop
        self._bar: tqdm[Any] | None = None
        self._state = ""
        self._last = 0.0
        self._ended = ("", 0)  # state and total of the count that was complete
        self.curves: list[Any] = []
        self.warnings: list[str] = []

    def reading(self, done: int, total: int) -> None:
        """Report that `done` of `total` messages or trials are read."""
        self._count("reading", done, total)

    def curating(self, done: int, total: int) -> None:
        """Report that `done` of `total` frames are curated, each of them counted in each pass."""
        self._count("curating", done, total)

    def _count(self, state: str, done: int, total: int) -> None:
        """Report a state from time to time, and at its end; raise CancelledError to end it."""
        if self._should_stop():
            raise CancelledError
        is_due = time.monotonic() - self._last > 0.2
        # A file may be at its end many times, while its last lines are read. An open bar is of a
        # later count.
        if done == total and self._ended == (state, total) and self._bar is None:
            return
        # A bar of each of many small files would hide the warnings.
        if is_due or done == total and (self.as_json or self._bar is not None):
            self._show(state, done, total, {})
        if done == total:
            self._close_bar()
            self._ended = (state, total)

    def training(self, progress: Any) -> None:
        """Report a `training.progress.Progress`, and keep it for the curves."""
        self.curves.append(progress)
        values = progress._asdict()
        values["combined"] = math.hypot(progress.loss, progress.cycle_error)
        step, steps = values.pop("step"), values.pop("steps")
        self._show("training", step, steps, values)

    def judging(self, message: str) -> None:
        """Report what is done after the last step."""
        self._close_bar()
        self._state = "judging"
        self.say(f"judging: {message}")

    def say(self, message: str) -> None:
        """Report a message."""
        if self.as_json:
            self._print({"state": self._state or "reading", "message": message})
        else:
            tqdm.write(message, file=sys.stderr)

    def warn(self, message: str) -> None:
        """Report a warning, and keep it for the page of the training."""
        self.warnings.append(message)
        self.say(f"warning: {message}")

    def end(self, state: str, message: str, **values: Any) -> None:
        """Report the end of the training: "finished", "cancelled" or "failed"."""
        self._close_bar()
        if self.as_json:
            self._print({"state": state, "message": message, **values})
        else:
            print(f"{state}: {message}", file=sys.stderr if state == "failed" else sys.stdout)

    def _show(self, state: str, done: int, total: int, values: dict[str, Any]) -> None:
        self._last = time.monotonic()
        if self.as_json:
            self._state = state
            self._print({"state": state, "step": done, "steps": total, **values})
            return
        if self._bar is None or self._state != state:
            self._close_bar()
            self._bar = tqdm(total=total, desc=state, dynamic_ncols=True)
        self._state = state
        self._bar.total = total
        shown = {k: f"{v:.3f}" for k, v in values.items() if k not in ("seconds_left", "seed")}
        self._bar.set_postfix(shown, refresh=False)
        self._bar.update(done - self._bar.n)

    def _close_bar(self) -> None:
        """Leave the bar as it is and stop its clock."""
        if self._bar is not None:
            self._bar.close()
        self._bar = None

    @staticmethod
    def _print(values: dict[str, Any]) -> None:
        rounded = {k: round(v, 5) if isinstance(v, float) else v for k, v in values.items()}
        try:
            print(json.dumps(rounded), flush=True)
        except BrokenPipeError:
            # The parent process is gone: `stop_with_parent` ends the training, which saves first.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class SilentReporter(Reporter):
    """Reports only failures of this process: the first process reports everything else."""

    def say(self, message: str) -> None:
        """Report nothing."""

    def end(self, state: str, message: str, **values: Any) -> None:
        """Report a failure, which may concern this machine alone."""
        if state == "failed":
            print(f"process {rank()} {state}: {message}", file=sys.stderr)

    def _show(self, state: str, done: int, total: int, values: dict[str, Any]) -> None:
        pass
