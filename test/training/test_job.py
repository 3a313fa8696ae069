# SPDX-License-Identifier: Apache-2.0
"""A training as a process of its own: whatever it does, its end is reported once."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros.training.config import TrainingConfig
from deep_nrsfm_ros.training.job import ENDED, JobStatus, TrainingJob, parse_progress

STAND_IN = (sys.executable, str(Path(__file__).with_name("stand_in_training.py")))
AUTOGROUP = Path("/proc/self/autogroup")
DEADLINE = 60


class Listener:
    """Collects the progress of a job."""

    def __init__(self) -> None:
        self._heard: SimpleQueue[JobStatus] = SimpleQueue()

    def __call__(self, progress: JobStatus) -> None:
        self._heard.put(progress)

    def next(self) -> JobStatus:
        return self._heard.get(timeout=DEADLINE)

    def until_end(self) -> list[JobStatus]:
        """Return all progress up to the end, which must be the last."""
        heard = [self.next()]
        while not heard[-1].ended:
            heard.append(self.next())
        return heard


def config(behaviour: str) -> TrainingConfig:
    return TrainingConfig().with_options({"name": behaviour})


def start(behaviour: str, **settings: Any) -> tuple[TrainingJob, Listener]:
    listener = Listener()
    return TrainingJob(config(behaviour), listener, command=STAND_IN, **settings), listener


def assert_gone(pid: int) -> None:
    """Assert that no process `pid` is left, not even as a zombie."""
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_progress_and_the_finished_model_are_reported() -> None:
    job, listener = start("finish")
    training, finished = listener.until_end()
    assert training.state == "training"
    assert (training.values["step"], training.values["loss"]) == (1, 0.5)
    assert (finished.state, finished.message) == ("finished", "done")
    assert finished.values["model"] == "new.safetensors"
    assert_gone(job.pid)


def test_a_training_on_data_that_looks_wrong_has_finished() -> None:
    _, listener = start("doubtful")
    finished = listener.until_end()[-1]
    assert finished.state == "finished" and finished.values["judgement"] == "doubtful"


def test_the_process_is_in_its_own_session_and_yields_to_others() -> None:
    job, listener = start("finish")
    values = listener.next().values
    assert values["session"] == job.pid
    assert os.getpriority(os.PRIO_PROCESS, 0) < 10
    job.close(DEADLINE)
    # The priority is set right after the start; the process may have asked before.
    assert values["niceness"] in (0, 10)


@pytest.mark.skipif(not AUTOGROUP.exists(), reason="this kernel does not group by session")
def test_its_session_yields_to_others_too() -> None:
    job, _ = start("wait")
    assert Path(f"/proc/{job.pid}/autogroup").read_text().endswith("nice 10\n")
    job.close(DEADLINE)


def test_cancel_keeps_what_there_is() -> None:
    job, listener = start("wait")
    listener.next()
    job.cancel()
    job.cancel()
    assert listener.until_end()[-1] == JobStatus(
        "cancelled", "kept the best of 1 step", {"model": "best.safetensors"}
    )
    assert_gone(job.pid)


def test_a_process_deaf_to_cancel_is_killed() -> None:
    job, listener = start("deaf", grace=0.2)
    listener.next()
    job.cancel()
    end = listener.until_end()[-1]
    assert end.state == "cancelled"
    assert_gone(job.pid)


def test_close_kills_a_deaf_process_in_time() -> None:
    job, listener = start("deaf")
    listener.next()
    job.close(0.2)
    assert listener.until_end()[-1].state == "cancelled"
    assert_gone(job.pid)


def test_close_does_not_wait_for_a_process_that_cannot_die(monkeypatch: pytest.MonkeyPatch) -> None:
    job, listener = start("deaf")
    listener.next()
    with monkeypatch.context() as patch:
        patch.setattr(job, "_signal", lambda number: None)  # as if a disk held it
        job.close(0.2)
        assert job.running
    job._signal(signal.SIGKILL)
    listener.until_end()
    assert_gone(job.pid)


def test_a_crash_is_reported_with_its_last_words() -> None:
    _, listener = start("crash")
    end = listener.until_end()[-1]
    assert end.state == "failed"
    assert "code 1" in end.message
    assert "the dictionary caught fire" in end.message


def test_a_killed_process_is_reported() -> None:
    job, listener = start("wait")
    listener.next()
    os.kill(job.pid, 9)
    end = listener.until_end()[-1]
    assert end.state == "failed"
    assert "SIGKILL" in end.message


def test_the_reason_of_a_refusal_is_passed_on() -> None:
    _, listener = start("refuse")
    end = listener.until_end()[-1]
    assert (end.state, end.message) == ("failed", "topic /nowhere is not in the bag")


def test_a_process_that_never_says_how_it_ended_has_failed() -> None:
    _, listener = start("mute")
    assert listener.until_end()[-1].state == "failed"


def test_a_command_that_does_not_exist_is_an_error_at_once() -> None:
    with pytest.raises(OSError, match="no-such-program"):
        TrainingJob(TrainingConfig(), lambda _: None, command=["/no-such-program"])


def test_the_process_ends_when_its_owner_is_killed() -> None:
    owner = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import sys, time\n"
            "from deep_nrsfm_ros.training.config import TrainingConfig\n"
            "from deep_nrsfm_ros.training.job import TrainingJob\n"
            "say = lambda _: print(job.pid, flush=True)\n"
            "config = TrainingConfig().with_options({'name': 'wait'})\n"
            "job = TrainingJob(config, say, command=sys.argv[1:])\n"
            "time.sleep(1000)",
            *STAND_IN,
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert owner.stdout is not None
    with owner:
        pid = int(owner.stdout.readline())
        owner.kill()
    deadline = time.monotonic() + DEADLINE
    while _alive(pid):
        assert time.monotonic() < deadline, f"training {pid} outlives its owner"
        time.sleep(0.05)


def _alive(pid: int) -> bool:
    """Tell whether `pid` runs; a zombie, which only its parent can bury, does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@settings(deadline=None)
@given(st.text())
def test_no_line_of_output_upsets_the_parser(line: str) -> None:
    progress = parse_progress(line)
    assert progress is None or progress.state


@settings(deadline=None)
@given(
    st.sampled_from(ENDED),
    st.dictionaries(st.text(), st.none() | st.booleans() | st.text() | st.lists(st.integers())),
)
def test_a_report_keeps_its_plain_values(state: str, values: dict[str, object]) -> None:
    progress = parse_progress(json.dumps({**values, "state": state}))
    assert progress is not None and progress.ended
    kept = {k: v for k, v in values.items() if not isinstance(v, list)}
    assert progress.values == {k: v for k, v in kept.items() if k not in ("state", "message")}
