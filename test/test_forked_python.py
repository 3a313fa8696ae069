# SPDX-License-Identifier: Apache-2.0
"""Forked programs start, speak, obey and end as those that Python starts."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from test.fixtures.forked_python import ForkedPython, children_of, forked_programs, run_forked

IMPORTS = ("colorsys",)
PROGRAM = """
import atexit, os, signal, sys, threading
atexit.register(print, "the end")
thread = threading.Timer(0.2, print, ["a thread"])
print(__name__, sys.argv, os.getcwd(), sys.path[0], os.environ["COLOUR"], "HOME" in os.environ)
print(os.getppid(), os.getsid(0) == os.getpid(), os.listdir("/proc/self/fd"))
print(signal.getsignal(signal.SIGINT), sys.stdin.read())
print("an error", file=sys.stderr)
thread.start()
"""


@pytest.fixture
def heeds_interrupts() -> Iterator[None]:
    """Ctrl-C is heeded, as in a terminal: a shell starts tests in the background without."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("heeds_interrupts")
@pytest.mark.parametrize("new_session", [False, True])
@pytest.mark.parametrize("words", [("-m", "program"), ("program.py",)])
def test_it_starts_and_ends_as_python_starts_it(
    tmp_path: Path, words: tuple[str, ...], new_session: bool
) -> None:
    (tmp_path / "program.py").write_text(PROGRAM)
    words = (*words, "one word", "ä", "")
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    given: dict[str, Any] = {"cwd": tmp_path, "env": {"COLOUR": "red"}, "text": True}
    given |= {"start_new_session": new_session} | pipes
    said = []
    for process in (
        ForkedPython(words, IMPORTS, **given),
        subprocess.Popen([sys.executable, *words], **given),
    ):
        with process:
            said.append((*process.communicate("asked", timeout=60), process.returncode))
    assert said[0] == said[1]
    assert said[0][0].endswith("asked\na thread\nthe end\n")


@pytest.mark.parametrize(
    ("end", "code"),
    [
        ("", 0),
        ("raise SystemExit(3)", 3),
        ("raise SystemExit('why')", 1),
        ("raise ValueError('why')", 1),
        ("os._exit(7)", 7),
        ("os.kill(os.getpid(), signal.SIGKILL)", -signal.SIGKILL),
        ("os.abort()", -signal.SIGABRT),
    ],
)
def test_its_exit_code_is_that_of_its_end(tmp_path: Path, end: str, code: int) -> None:
    program = tmp_path / "program.py"
    program.write_text(f"import os, signal\n{end}\n")
    done = run_forked([program], IMPORTS)
    assert done.returncode == code
    assert ("why" in done.stderr) == ("why" in end)


def test_it_is_waited_for_and_signalled_as_any_child(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text("import time\nprint('ready', flush=True)\ntime.sleep(60)\n")
    with ForkedPython([program], IMPORTS, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as it:
        assert it.stdout is not None and it.stdout.readline() == "ready\n"
        assert it.poll() is None
        with pytest.raises(subprocess.TimeoutExpired):
            it.wait(0.01)
        it.send_signal(signal.SIGINT)
        ended = os.waitid(os.P_PID, it.pid, os.WEXITED | os.WNOWAIT)
        assert ended is not None and ended.si_pid == it.pid
        assert it.wait(60) == -signal.SIGINT  # as Python ends by a Ctrl-C that nobody handles
        assert not Path(f"/proc/{it.pid}").exists()


def test_programs_leave_each_other_alone(tmp_path: Path) -> None:
    """What one changes in the server's modules or environment does not reach the next."""
    program = tmp_path / "program.py"
    program.write_text(
        f"import os, sys, {IMPORTS[0]} as it\n"
        "print(getattr(it, 'changed', False), os.environ.get('COLOUR'))\n"
        "it.changed, os.environ['COLOUR'] = True, 'red'\n"
    )
    outputs = [run_forked([program], IMPORTS, env={}).stdout for _ in range(2)]
    assert outputs == ["False None\n"] * 2


PARENT = r"""
import os, subprocess, sys
from pathlib import Path
from test.fixtures.forked_python import children_of
code = "import os, sys; print(os.getppid(), 'colorsys' in sys.modules, open(sys.argv[1]).read())"
Path("child.py").write_text(code)
reader, writer = os.pipe()
os.write(writer, b"of a pipe")
os.close(writer)
words = [sys.executable, "-u", "child.py", f"/dev/fd/{reader}"]
child = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, pass_fds=[reader])
assert children_of(os.getpid()) == [child.pid]
print(child.communicate()[0].split(maxsplit=1) == [str(os.getpid()), "True of a pipe\n"])
print(child.returncode, children_of(os.getpid()))
"""


def test_programs_that_it_starts_are_forked_too(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(PARENT)
    assert run_forked([program], IMPORTS, cwd=tmp_path).stdout.startswith("False\n0 []")
    forked = run_forked([program], IMPORTS, forks=True, cwd=tmp_path)
    assert forked.stdout.startswith("True\n0 []"), forked.stderr


def test_programs_of_this_process_are_forked_within_the_context(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text("import sys; print('colorsys' in sys.modules)\n")
    words, before = [sys.executable, "program.py"], children_of(os.getpid())
    with forked_programs(IMPORTS):
        within = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
        other = subprocess.run(["echo", "not Python"], capture_output=True, text=True)
    after = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert [done.stdout for done in (within, other, after)] == ["True\n", "not Python\n", "False\n"]
    assert set(children_of(os.getpid())) <= set(before)


def test_modules_are_found_where_its_environment_says(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "found_there.py").write_text("print('found')\n")
    env = os.environ | {"PYTHONPATH": f"{tmp_path / 'elsewhere'}"}
    assert run_forked(["-m", "found_there"], IMPORTS, env=env).stdout == "found\n"


def test_a_server_ends_with_the_process_that_started_it() -> None:
    code = (
        "from test.fixtures.forked_python import _server, run_forked\n"
        "assert run_forked(['-m', 'this'], ('colorsys',)).returncode == 0\n"
        "print(_server(('colorsys',)).process.pid)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    deadline = time.monotonic() + 60
    while Path(f"/proc/{int(done.stdout)}").exists():
        assert time.monotonic() < deadline, "the server is left over"
        time.sleep(0.01)


def test_a_server_that_cannot_import_says_so(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RuntimeError, match="ended with exit code 1"):
        run_forked(["-m", "this"], ("no_such_module",))
    assert "No module named 'no_such_module'" in capfd.readouterr().err
