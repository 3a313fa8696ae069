"""What a training tells: progress for people or for a program, warnings, and how it ended."""

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
    """Somebody stopped the training before it began."""


class Reporter:
    """Shows progress to people (a bar) or to a program (JSON lines)."""

    def __init__(self, as_json: bool, should_stop: Callable[[], bool]) -> None:
        """Start silent; the bar appears with the first progress.

        should_stop: ends reading, which may take minutes, by `CancelledError`.
        """
        self.as_json, self._should_stop = as_json, should_stop
        self._bar: tqdm[Any] | None = None
        self._state = ""
        self._last = 0.0
        self.curves: list[Any] = []
        self.warnings: list[str] = []

    def reading(self, done: int, total: int) -> None:
        """Report that `done` of `total` messages or trials are read."""
        if self._should_stop():
            raise CancelledError
        if done == total or time.monotonic() - self._last > 0.2:
            self._show("reading", done, total, {})
        if done == total:
            self._close_bar()

    def training(self, progress: Any) -> None:
        """Report a `nrsfm.progress.Progress`, and keep it for the curves."""
        self.curves.append(progress)
        values = progress._asdict()
        values["combined"] = math.hypot(progress.loss, progress.cycle_error)
        step, steps = values.pop("step"), values.pop("steps")
        self._show("training", step, steps, values)

    def say(self, message: str) -> None:
        """Report something worth reading."""
        if self.as_json:
            self._print({"state": self._state or "reading", "message": message})
        else:
            tqdm.write(message, file=sys.stderr)

    def warn(self, message: str) -> None:
        """Report something that the report of the training shall say too."""
        self.warnings.append(message)
        self.say(f"warning: {message}")

    def end(self, state: str, message: str, **values: Any) -> None:
        """Report how it ended."""
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
        """Leave the bar as it is; the time it shows no longer runs."""
        if self._bar is not None:
            self._bar.close()
        self._bar = None

    @staticmethod
    def _print(values: dict[str, Any]) -> None:
        rounded = {k: round(v, 5) if isinstance(v, float) else v for k, v in values.items()}
        try:
            print(json.dumps(rounded), flush=True)
        except BrokenPipeError:
            # Who listened is gone: `stop_with_parent` ends the training, which saves first.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class SilentReporter(Reporter):
    """Leaves the talking to the first process, but for what went wrong in this one."""

    def say(self, message: str) -> None:
        """Say nothing."""

    def end(self, state: str, message: str, **values: Any) -> None:
        """Report a failure, which may be of this machine alone."""
        if state == "failed":
            print(f"process {rank()} {state}: {message}", file=sys.stderr)

    def _show(self, state: str, done: int, total: int, values: dict[str, Any]) -> None:
        pass
