# SPDX-License-Identifier: Apache-2.0
"""One command for all programs; each says how it was called."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from deep_nrsfm_ros import __version__
from deep_nrsfm_ros.commands import cli, program
from test.fixtures.forked_python import NODE, run_forked

SCRIPTS = Path(__file__).parents[2] / "scripts"


def test_help_lists_every_program_with_a_line() -> None:
    command = [sys.executable, "-m", "deep_nrsfm_ros", "--help"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith("usage: python -m deep_nrsfm_ros ")
    lines = [line.split() for line in done.stdout.splitlines()]
    for name, text in cli.PROGRAMS.items():
        assert [name, *text.split()] in lines


def test_every_script_is_a_program() -> None:
    assert {path.name for path in SCRIPTS.iterdir()} == {*cli.PROGRAMS, "mediapipe_detector"}


@pytest.mark.parametrize("name", cli.PROGRAMS)
def test_a_program_says_how_it_was_called(name: str) -> None:
    for words, called in {
        ("-m", "deep_nrsfm_ros", name): f"python -m deep_nrsfm_ros {name}",
        ("-m", f"deep_nrsfm_ros.commands.{name}"): f"python -m deep_nrsfm_ros.commands.{name}",
        (str(SCRIPTS / name),): name,
    }.items():
        done = run_forked([*words, "--help"], NODE)
        assert done.returncode == 0, done.stderr
        assert done.stdout.startswith(f"usage: {called} ")


def test_ros2_run_shows_in_the_usage(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["/opt/lib/deep_nrsfm_ros/lift"])
    assert program.program_name("lift") == "ros2 run deep_nrsfm_ros lift"


def test_an_unknown_program_is_refused_with_the_nearest(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for word, hint in {
        "trian": "did you mean 'train'?",
        "zzz": "choose one of demo, lift,",
    }.items():
        with pytest.raises(SystemExit) as end:
            cli.main([word, "--help"])
        assert end.value.code == 2
        assert f"there is no command {word!r}; {hint}" in capsys.readouterr().err


def test_a_missing_program_is_named_as_the_help_names_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main([])
    assert end.value.code == 2
    assert capsys.readouterr().err.endswith("arguments are required: COMMAND\n")


@pytest.mark.parametrize(
    "words", [["-p", "keypoint_layout:=coco17"], ["--ros-args", "-p", "a:=1", "--", "-p", "b:=2"]]
)
def test_arguments_that_ros_would_ignore_are_refused(words: list[str]) -> None:
    done = run_forked(["-m", "deep_nrsfm_ros", "lifter", *words], NODE)
    assert done.returncode == 2
    assert f"failed: {' '.join(words[-2:])!r} has no effect" in done.stderr
    assert "lifter --ros-args -p NAME:=VALUE" in done.stderr


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["--version"])
    assert __version__ in capsys.readouterr().out


def test_only_the_module_of_the_program_is_imported() -> None:
    code = (
        "import sys; from deep_nrsfm_ros.commands import cli\n"
        "try: cli.main(['models', '--help'])\n"
        "except SystemExit: pass\n"
        "loaded = {m.rpartition('.')[2] for m in sys.modules if '.commands.' in m}\n"
        "assert loaded == {'cli', 'program', 'models'}, loaded"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
