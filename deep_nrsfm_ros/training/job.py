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

from deep_nrsfm_ros.training.config import TrainingConfig

Value = str | int | float | None

ACTIVE = ("starting", "reading", "training")
ENDED = ("finished", "failed", "cancelled")
TRAIN_COMMAND = (sys.executable, "-m", "deep_nrsfm_ros.commands.train")

_LAST_WORDS = 10
_DYING = 0.5  # seconds that a process has to die of SIGKILL
_NICENESS = 10  # a tenth of the share of others; at 19 it gets nothing on a busy machine
_LINE_LIMIT = 65536
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


class Progress(NamedTuple):
    """One step of a training run: its state, a line for people, and named figures."""

    state: str
    message: str
    values: dict[str, Value]

    @property
    def ended(self) -> bool:
        """Tell whether nothing will follow."""
        return self.state in ENDED


class TrainingJob:
    """One run of the training command, from its start to its end.

    The process runs at a low priority in a session of its own, so that neither Ctrl-C nor its load
    reaches the lifter. It reads its configuration from a file in memory (`--config`). It prints
    one JSON object a line, {"state": ..., ...}; the last other lines are kept as its last words.
    Its standard input is a pipe: end of file means that the lifter is gone, and the process ends.
    """

    def __init__(
        self,
        config: TrainingConfig,
        on_progress: Callable[[Progress], None],
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
        self._said: Progress | None = None
        self._last_words: deque[str] = deque(maxlen=_LAST_WORDS)
        threads = str(config.output.threads or os.cpu_count() or 1)
        with _file_in_memory(config.to_json()) as file:
            self._process = subprocess.Popen(
                [*command, "--config", f"/dev/fd/{file.fileno()}", "--json-progress"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env=os.environ | dict.fromkeys(_THREAD_VARIABLES, threads),
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
        """Tell whether the end has yet to be reported."""
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

        One that a disk or a driver holds dies when that lets go of it: nobody waits for it here.
        """
        self.cancel()
        self._watcher.join(timeout)
        if self.running:
            self._signal(signal.SIGKILL)
            self._watcher.join(_DYING)

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
            self._last_words.append(line)
            return
        self._said = progress
        if not progress.ended:
            self._on_progress(progress)

    def _ending(self, code: int) -> Progress:
        """Return the last progress of a process that ended with `code`."""
        said, values = self._said, self._said.values if self._said else {}
        if said and said.ended and (code == 0 or said.state == "failed"):
            return said
        if self._cancelled:
            return Progress("cancelled", "stopped before there was a model to keep", values)
        how = f"by {signal.Signals(-code).name}" if code < 0 else f"with code {code}"
        words = "\n".join(self._last_words) or "it said nothing"
        return Progress("failed", f"the training process ended {how}; its last words:\n{words}", {})


def _file_in_memory(text: str) -> BinaryIO:
    """Return an open file without a name that holds `text`: nothing is left of it on any disk."""
    file = os.fdopen(os.memfd_create("training_config"), "w+b")
    file.write(text.encode())
    file.flush()
    return file


def _yield_to_others(pid: int) -> None:
    """Give a process that leads a session a low priority, and let it go first for memory.

    Where Linux groups processes by session, as on a desktop, priorities count within a session
    only, and the session has one of its own.
    """
    with suppress(OSError):  # it ended already, or there are no such groups
        os.setpriority(os.PRIO_PROCESS, pid, _NICENESS)
        Path(f"/proc/{pid}/oom_score_adj").write_text("1000")
        Path(f"/proc/{pid}/autogroup").write_text(str(_NICENESS))


def parse_progress(line: str) -> Progress | None:
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
    return Progress(state, str(message), values)


def _in_words(state: str, report: dict[str, Any]) -> str:
    """Return e.g. "training: 300 of 3000, 12 s left"."""
    words = state
    if "step" in report and "steps" in report:
        words += f": {report['step']} of {report['steps']}"
    left = report.get("seconds_left")
    return words + (f", {left:.0f} s left" if isinstance(left, (int, float)) else "")
