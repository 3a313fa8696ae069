"""Diagnostics of the lifter: its health, counted and judged, and the message that reports it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from numpy.typing import NDArray

OK, WARN, ERROR = range(3)

_SILENCE = 3.0
_POOR_FIT = 0.3
_UNSURE = 0.3


class Report(NamedTuple):
    """A level of `OK`, `WARN` or `ERROR`, one line that says why, and named figures."""

    level: int
    message: str
    values: dict[str, str]


class Health:
    """Counts what happens to messages and sums it up.

    ERROR: messages came since the last report and none could be lifted, or there is a publisher
    that cannot be heard and nothing else to lift.
    WARN: some messages could not be lifted; none has come for 3 s; more were missed, having come
    while others were lifted, than were lifted; half of the objects seen since the last report fit
    the model worse than a reprojection error of 0.3; or half of them have a confidence below 0.3.
    OK: otherwise.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin to count; `clock` gives seconds."""
        self._clock = clock
        self._last_input = self._last_report = clock()
        self._seconds: list[float] = []
        self._errors: list[NDArray[np.float32]] = []
        self._confidences: list[NDArray[np.float32]] = []
        self._rejected = self._empty = self._missed = 0
        self._unheard = ""
        self.total_lifted = 0
        self.total_empty = 0
        self.total_rejected = 0
        self.total_missed = 0
        self.last_problem = ""

    @property
    def idle(self) -> bool:
        """Tell whether no message has come since the last report."""
        return not self._seconds and not self._rejected and not self._empty

    def lifted(
        self,
        seconds: float,
        reprojection_error: NDArray[np.float32],
        confidence: NDArray[np.float32],
    ) -> None:
        """Count a message that took `seconds`.

        reprojection_error: (n) of its objects, NaN of those that could not be lifted.
        confidence: (n, p) of their keypoints. Both are kept until the report, which sums them up.
        """
        self._last_input = self._clock()
        self._seconds.append(seconds)
        self._errors.append(reprojection_error)
        self._confidences.append(confidence)
        self._unheard = ""
        self.total_lifted += 1

    def saw_nothing(self) -> None:
        """Count a message without any object: the detector works and sees none."""
        self._last_input = self._clock()
        self._empty += 1
        self._unheard = ""
        self.total_empty += 1

    def rejected(self, reason: str) -> None:
        """Count a message that could not be lifted, and remember why."""
        self._last_input = self._clock()
        self._rejected += 1
        self.total_rejected += 1
        self.last_problem = reason

    def missed(self, count: int) -> None:
        """Count messages that were sent and never came."""
        self._missed += count
        self.total_missed += count

    def unheard(self, reason: str) -> None:
        """Remember that there is a publisher whose messages do not arrive, and why."""
        self._unheard = self.last_problem = reason

    def report(self) -> Report:
        """Return how the time since the last report went, and begin anew."""
        now = self._clock()
        seconds = np.array(self._seconds or [np.nan])
        error, confidence = self._medians()
        rate = len(self._seconds) / max(now - self._last_report, 1e-9)
        level, message = self._judge(now - self._last_input, error, confidence)
        values = {
            "rate [Hz]": f"{rate:.1f}",
            "processing time p50 [ms]": f"{np.median(seconds) * 1e3:.3f}",
            "processing time max [ms]": f"{seconds.max() * 1e3:.3f}",
            "reprojection error": f"{error:.4f}",
            "confidence": f"{confidence:.2f}",
            "messages lifted": str(self.total_lifted),
            "messages without objects": str(self.total_empty),
            "messages rejected": str(self.total_rejected),
            "messages missed": str(self.total_missed),
            "last problem": self.last_problem or "none",
        }
        self._last_report, self._rejected, self._empty, self._missed = now, 0, 0, 0
        self._seconds.clear()
        self._errors.clear()
        self._confidences.clear()
        return Report(level, message, values)

    def _medians(self) -> tuple[float, float]:
        """Return the reprojection error and confidence of half of the objects, NaN if none."""
        if not self._errors:
            return np.nan, np.nan
        error = np.concatenate(self._errors)
        models = groupby(self._confidences, lambda one: one.shape[1])  # of as many keypoints each
        confidence = np.concatenate([np.concatenate(list(of)).mean(1) for _, of in models])
        known = ~np.isnan(error)
        if not known.any():
            return np.nan, np.nan
        return float(np.median(error[known])), float(np.median(confidence[known]))

    def _judge(self, silence: float, error: float, confidence: float) -> tuple[int, str]:
        """Return level and message by the rules of the class."""
        if self._rejected:
            came = self._rejected + len(self._seconds)
            level = WARN if self._seconds else ERROR
            return level, f"{self._rejected} of {came} messages rejected: {self.last_problem}"
        if self._unheard:
            return ERROR, self._unheard
        if silence > _SILENCE:
            return WARN, f"no keypoints for {silence:.0f} s"
        if self._missed > (came := len(self._seconds) + self._empty):
            return WARN, (
                f"{self._missed} of {self._missed + came} messages missed: they come faster than "
                "they are lifted; set test_time_rotations to 1 or refill to 0, or send fewer"
            )
        if error > _POOR_FIT:
            return WARN, f"poor fit: half of the reprojection errors are above {error:.2f}"
        if confidence < _UNSURE:
            return WARN, f"low confidence: that of half of the objects is below {confidence:.2f}"
        if self._empty and not self._seconds:
            return OK, "the detector sees no object"
        return OK, "lifting" if self._seconds else "waiting for keypoints"


def status(
    name: str, level: int, message: str, values: Mapping[str, Any], hardware_id: str = ""
) -> DiagnosticStatus:
    """Return a diagnostic status with its values as text."""
    return DiagnosticStatus(
        level=bytes([level]),
        name=name,
        message=message,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
    )
