# SPDX-License-Identifier: Apache-2.0
"""Diagnostics of the lifter: counts of messages, their rating, and the message on /diagnostics."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from numpy.typing import NDArray

OK, WARN, ERROR = range(3)
"""Levels of diagnostic_msgs/DiagnosticStatus."""

_MAX_SILENCE = 3.0  # seconds without a message
_PROBLEM_TIME = 60.0  # seconds for which a problem is shown
_PROBLEM_OVER = 2.0  # seconds after which its age is shown too
_MAX_RESIDUAL = 0.3  # median residual
_MIN_CONFIDENCE = 0.3  # median confidence of objects


class Report(NamedTuple):
    """Result of one reporting period.

    Attributes:
        level: `OK`, `WARN` or `ERROR`.
        message: one line that says why.
        values: named figures as text.
    """

    level: int
    message: str
    values: dict[str, str]


class LifterDiagnostics:
    """Counts messages and rates each reporting period.

    ERROR: messages were received and none could be lifted; or a publisher cannot be received and no
        other message was lifted.
    WARN: some messages were rejected; no message for 3 s; more messages were dropped than received;
        the median residual is above 0.3; the median confidence is below 0.3; or
        something is wrong with the frame of the points.
    OK: otherwise.

    Attributes:
        total_lifted: messages lifted since the start.
        total_empty: messages without objects since the start.
        total_rejected: messages since the start that could not be lifted.
        total_dropped: messages since the start that were sent and not received.
        last_problem: reason of the last rejected message or publisher that cannot be received; ""
            when it is a minute old.
        frame_problem: what is wrong with the frame of points in this period; "" if nothing is.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Start all counts at 0.

        Args:
            clock: returns seconds.
        """
        self._clock = clock
        self._last_input = self._last_report = clock()
        self._seconds: list[float] = []
        self._residuals: list[NDArray[np.float32]] = []
        self._confidences: list[NDArray[np.float32]] = []
        self._rejected = self._empty = self._dropped = 0
        self._publisher_problem = ""
        self.total_lifted = 0
        self.total_empty = 0
        self.total_rejected = 0
        self.total_dropped = 0
        self._problem, self._problem_time = "", 0.0
        self.frame_problem = ""

    @property
    def last_problem(self) -> str:
        """The reason of the last problem; "" if there was none within a minute."""
        return self._problem if self._clock() - self._problem_time <= _PROBLEM_TIME else ""

    @property
    def idle(self) -> bool:
        """Whether no message has been received since the last report."""
        return not self._seconds and not self._rejected and not self._empty

    @property
    def residual(self) -> float:
        """The median residual of objects since the last report; NaN if none."""
        return self._medians()[0]

    def lifted(
        self, seconds: float, residual: NDArray[np.float32], confidence: NDArray[np.float32]
    ) -> None:
        """Count a lifted message; the arrays are kept until the report, which sums them up.

        Args:
            seconds: processing time.
            residual: (n,) residuals of its objects, NaN if not lifted.
            confidence: (n, p) of their keypoints.
        """
        self._last_input = self._clock()
        self._seconds.append(seconds)
        self._residuals.append(residual)
        self._confidences.append(confidence)
        self._publisher_problem = ""
        self.total_lifted += 1

    def empty(self) -> None:
        """Count a message without objects."""
        self._last_input = self._clock()
        self._empty += 1
        self._publisher_problem = ""
        self.total_empty += 1

    def rejected(self, reason: str) -> None:
        """Count a message that could not be lifted."""
        self._last_input = self._clock()
        self._rejected += 1
        self.total_rejected += 1
        self._note(reason)

    def dropped(self, count: int) -> None:
        """Count messages that were sent and not received."""
        self._dropped += count
        self.total_dropped += count

    def publisher_problem(self, reason: str) -> None:
        """Record why the messages of a publisher cannot be received."""
        self._publisher_problem = reason
        self._note(reason)

    def _note(self, reason: str) -> None:
        """Keep the reason of a problem, and when it was."""
        self._problem, self._problem_time = reason, self._clock()

    def report(self) -> Report:
        """Return the report of the period since the last one, and start the next period."""
        now = self._clock()
        seconds = np.array(self._seconds or [np.nan])
        residual, confidence = self._medians()
        rate = len(self._seconds) / max(now - self._last_report, 1e-9)
        level, message = self._rate_period(now - self._last_input, residual, confidence)
        values = {
            "rate [Hz]": f"{rate:.1f}",
            "processing time p50 [ms]": f"{np.median(seconds) * 1e3:.3f}",
            "processing time max [ms]": f"{seconds.max() * 1e3:.3f}",
            "residual": f"{residual:.4f}",
            "confidence": f"{confidence:.2f}",
            "messages lifted": str(self.total_lifted),
            "messages without objects": str(self.total_empty),
            "messages rejected": str(self.total_rejected),
            "messages dropped": str(self.total_dropped),
            "last problem": self._last_problem_status(now),
        }
        self._last_report, self._rejected, self._empty, self._dropped = now, 0, 0, 0
        self.frame_problem = ""
        self._seconds.clear()
        self._residuals.clear()
        self._confidences.clear()
        return Report(level, message, values)

    def _last_problem_status(self, now: float) -> str:
        """Return the last problem as text, with its age as soon as it is over."""
        if not self.last_problem:
            return "none"
        age = now - self._problem_time
        return self.last_problem + (f" ({age:.0f} s ago)" if age >= _PROBLEM_OVER else "")

    def _medians(self) -> tuple[float, float]:
        """Return median residual and confidence of the lifted objects, NaN if none."""
        if not self._residuals:
            return np.nan, np.nan
        residual = np.concatenate(self._residuals)
        # Models with different numbers of keypoints may follow one another in a period.
        models = groupby(self._confidences, lambda array: array.shape[1])
        confidence = np.concatenate([np.concatenate(list(of)).mean(1) for _, of in models])
        lifted = ~np.isnan(residual)
        if not lifted.any():
            return np.nan, np.nan
        return float(np.median(residual[lifted])), float(np.median(confidence[lifted]))

    def _rate_period(self, silence: float, residual: float, confidence: float) -> tuple[int, str]:
        """Return level and message by the rules of the class."""
        if self._rejected:
            received = self._rejected + len(self._seconds)
            level = WARN if self._seconds else ERROR
            return level, f"{self._rejected} of {received} messages rejected: {self.last_problem}"
        if self._publisher_problem:
            return ERROR, self._publisher_problem
        if silence > _MAX_SILENCE:
            return WARN, f"no keypoints for {silence:.0f} s"
        if self._dropped > (received := len(self._seconds) + self._empty):
            return WARN, (
                f"{self._dropped} of {self._dropped + received} messages dropped: they arrive "
                "faster than they are lifted; set test_time_rotations to 1 or refill to 0, or send "
                "fewer"
            )
        problems = [self.frame_problem] if self.frame_problem else []
        if residual > _MAX_RESIDUAL:
            problems.insert(0, f"poor fit: median residual {residual:.2f}")
        elif confidence < _MIN_CONFIDENCE:
            problems.insert(0, f"low confidence: median {confidence:.2f}")
        if problems:
            return WARN, "; ".join(problems)
        if self._empty and not self._seconds:
            return OK, "the detector sees no object"
        return OK, "lifting" if self._seconds else "waiting for keypoints"


def status(
    name: str, level: int, message: str, values: Mapping[str, Any], hardware_id: str
) -> DiagnosticStatus:
    """Return a diagnostic status whose values are written as text.

    Args:
        name: of the status, "/namespace/node: task".
        level: `OK`, `WARN` or `ERROR`.
        message: one line that says why.
        values: named figures.
        hardware_id: full name of the node, by which aggregators tell lifters apart.
    """
    return DiagnosticStatus(
        level=bytes([level]),
        name=name,
        message=message,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
    )
