# SPDX-License-Identifier: Apache-2.0
"""A training run as a process of its own: started, watched, cancelled. Knows nothing of ROS."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from deep_nrsfm_ros.lifting.sanity import EXIT_DOUBTFUL
from deep_nrsfm_ros.training.config import TrainingConfig

Value = str | int | float | None

ACTIVE = ("starting", "reading", "curating", "training", "judging")
ENDED = ("finished", "failed", "cancelled")
FOR_NODE = "DEEP_NRSFM_FOR_NODE"
"""Variable of the environment with which a training names parameters, and no options."""
TRAIN_COMMAND = (sys.executable, "-m", "deep_nrsfm_ros.commands.train")

_OUTPUT_TAIL = 10  # lines
_KILL_TIMEOUT = 0.5  # s, from SIGKILL to the end of the process
_NICENESS = 10  # about a tenth of the CPU time of a process at 0; 19 gets almost none
_LINE_LIMIT = 65536
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


class JobStatus(NamedTuple):
    """One step of a training run: its state, a line for people, and named figures."""

    state: str
    message: str
    values: dict[str, Value]

    @property
    def ended(self) -> bool:
        """Whether this is the last status."""
        return self.state in ENDED


class TrainingJob:
    """One run of the training command, from its start to its end.

    The process has a session of its own, so that Ctrl-C in the lifter's terminal does not reach it,
    and a low priority, so that it does not slow the lifter. It reads its configuration from a file
    in memory (`--config`). It prints one JSON object a line, {"state": ..., ...}; the last other
    lines are kept for the report of a failure. Its standard input is a pipe: end of file means that
    the lifter is gone, and the process ends.
    """

    def __init__(
        self,
        config: TrainingConfig,
        on_progress: Callable[[JobStatus], None],
        *,
        grace: float = 20.0,
        command: Sequence[str] = TRAIN_COMMAND,
    ) -> None:
        """Start the training; raise OSError if the process cannot be started.

        Args:
            config: the training. Its threads are those that the numerical libraries may use too.
            on_progress: called from a thread of the job with each progress. The last one, and only
                that, has `ended` set, and comes when the process is gone.
            grace: seconds from `cancel` until a process that does not react is killed.
            command: the training command.
        """
        self._on_progress = on_progress
        self._grace = grace
        self._cancelled = False
        self._last_status: JobStatus | None = None
        self._output_tail: deque[str] = deque(maxlen=_OUTPUT_TAIL)
        threads = str(config.output.threads or os.cpu_count() or 1)
        with _file_in_memory(config.to_json()) as file:
            self._process = subprocess.Popen(
                [*command, "--config", f"/dev/fd/{file.fileno()}", "--json-progress"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env=os.environ | dict.fromkeys(_THREAD_VARIABLES, threads) | {FOR_NODE: "1"},
                pass_fds=[file.fileno()],
            )
        _yield_to_others(self._process.pid)
        self._watcher = threading.Thread(target=self._watch, name="training", daemon=True)
        self._watcher.start()

    @property
    def pid(self) -> int:
        """Process id of the training."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether the last status is still to come."""
        return self._watcher.is_alive()

    def cancel(self) -> None:
        """Ask the process to stop with the best model so far; kill it when the grace is over."""
        if self._cancelled:
            return
        self._cancelled = True
        self._signal(signal.SIGTERM)
        threading.Thread(target=self._kill_late, daemon=True).start()

    def close(self, timeout: float) -> None:
        """Cancel and return when the process is gone; kill it after `timeout` seconds.

        A process in uninterruptible I/O ends only when the I/O returns: after SIGKILL this waits at
        most 0.5 s.
        """
        self.cancel()
        self._watcher.join(timeout)
        if self.running:
            self._signal(signal.SIGKILL)
            self._watcher.join(_KILL_TIMEOUT)

    def _kill_late(self) -> None:
        """Kill a process that outlives its grace."""
        self._watcher.join(self._grace)
        if self.running:
            self._signal(signal.SIGKILL)

    def _signal(self, number: signal.Signals) -> None:
        """Send a signal to the process, or SIGKILL to it and all that it has started."""
        try:
            if number == signal.SIGKILL:
                os.killpg(self.pid, number)
            else:
                self._process.send_signal(number)
        except ProcessLookupError:
            pass  # it ended by itself in this moment

    def _watch(self) -> None:
        """Pass on what the process says until it is gone, then report how it ended."""
        assert self._process.stdout is not None and self._process.stdin is not None
        with self._process.stdout as lines, self._process.stdin:
            for line in iter(lambda: lines.readline(_LINE_LIMIT), b""):
                self._listen(line.decode(errors="replace").strip())
            code = self._process.wait()
        self._on_progress(self._ending(code))

    def _listen(self, line: str) -> None:
        """Report a line of progress; remember any other line."""
        progress = parse_progress(line)
        if progress is None:
            self._output_tail.append(line)
            return
        self._last_status = progress
        if not progress.ended:
            self._on_progress(progress)

    def _ending(self, code: int) -> JobStatus:
        """Return the last progress of a process that ended with `code`."""
        last = self._last_status
        values = last.values if last else {}
        if last and last.ended and (code in (0, EXIT_DOUBTFUL) or last.state != "finished"):
            return last
        if self._cancelled:
            return JobStatus("cancelled", "stopped before there was a model to keep", values)
        how = f"by {signal.Signals(-code).name}" if code < 0 else f"with code {code}"
        words = "\n".join(self._output_tail) or "it printed nothing"
        return JobStatus(
            "failed", f"the training process ended {how}; its last output:\n{words}", {}
        )


def _file_in_memory(text: str) -> BinaryIO:
    """Return an open file without a name that holds `text`: nothing is left of it on any disk."""
    file = os.fdopen(os.memfd_create("training_config"), "w+b")
    file.write(text.encode())
    file.flush()
    return file


def _yield_to_others(pid: int) -> None:
    """Give a process a low priority, and make it the first one killed when memory runs out.

    With the autogroup scheduling of Linux a nice value counts only within its session, so that the
    nice value of the session is set too.
    """
    with suppress(OSError):  # it ended already, or there are no such groups
        os.setpriority(os.PRIO_PROCESS, pid, _NICENESS)
        Path(f"/proc/{pid}/oom_score_adj").write_text("1000")
        Path(f"/proc/{pid}/autogroup").write_text(str(_NICENESS))


def parse_progress(line: str) -> JobStatus | None:
    """Return the progress that a line of output reports; None if it reports none."""
    try:
        report = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(report, dict) or report.get("state") not in (*ACTIVE, *ENDED):
        return None
    state = report.pop("state")
    message = report.pop("message", "") or _in_words(state, report)
    values = {
        str(key): value
        for key, value in report.items()
        if value is None or isinstance(value, (str, int, float))
    }
    return JobStatus(state, str(message), values)


def _in_words(state: str, report: dict[str, Any]) -> str:
    """Return e.g. "training: 300 of 3000, 12 s left"."""
    words = state
    if "step" in report and "steps" in report:
        words += f": {report['step']} of {report['steps']}"
    left = report.get("seconds_left")
    return words + (f", {left:.0f} s left" if isinstance(left, (int, float)) else "")
