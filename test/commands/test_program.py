# SPDX-License-Identifier: Apache-2.0
"""What every program does, as a shell starts it."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from deep_nrsfm_ros.commands import doctor, evaluate, lift, models, replay, train
from deep_nrsfm_ros.commands.demo import first_look
from deep_nrsfm_ros.commands.program import program

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.mark.parametrize("name", ["models", "evaluate", "train"])
def test_a_reader_that_leaves_ends_a_program_silently(name: str, tmp_path: Path) -> None:
    words = {
        "models": ["--models-dir", str(tmp_path)],
        "evaluate": ["human", "--cmu", str(tmp_path)],
        "train": ["--bag", "absent", "--json-progress"],
    }
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run(
            [sys.executable, str(SCRIPTS / name), *words[name]],
            stdin=subprocess.DEVNULL,
            stdout=writer,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": str(SCRIPTS.parent)},
        )
    finally:
        os.close(writer)
    # evaluate keeps its lines until it has enough of them, and fails before.
    assert done.stderr.count("\n") <= (name == "evaluate"), done.stderr
    assert "Traceback" not in done.stderr and "BrokenPipe" not in done.stderr
    assert done.returncode == -signal.SIGPIPE


def test_ctrl_c_ends_a_program_with_a_word(capsys: pytest.CaptureFixture[str]) -> None:
    @program
    def main(_: Sequence[str] | None = None) -> None:
        raise KeyboardInterrupt

    with pytest.raises(SystemExit) as end:
        main([])
    assert end.value.code == 130
    assert capsys.readouterr().err == "interrupted\n"


@pytest.mark.parametrize(
    ("parser", "words", "hint"),
    [
        (lift.arguments, "a.npy --output b.npz --mirror", "did you mean '--mirrored'?"),
        (lift.arguments, "a.npy --output b.npz --intrinsic=c.yaml", "'--intrinsics'?"),
        (lift.arguments, "a --output b --key coco17", "did you mean '--keypoint-layout'?"),
        (replay.arguments, "a.npy --ht", "did you mean '--html'?"),
        (train.parser, "--keypoint-layuot coco17", "did you mean '--keypoint-layout'?"),
        (models.arguments, "--models-folder x", "did you mean '--models-dir'?"),
        (doctor.arguments, "--time 3", "did you mean '--timeout'?"),
        (evaluate.arguments, "human --subject 01", "did you mean '--subjects'?"),
        (first_look.arguments, "--nothing-like-it", "unrecognized arguments: --nothing-like-it"),
    ],
)
def test_an_option_is_taken_by_its_whole_name_only(
    parser: Callable[[], argparse.ArgumentParser],
    words: str,
    hint: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit, match="2"):
        parser().parse_args(words.split())
    (line,) = capsys.readouterr().err.splitlines()[-1:]
    assert "unrecognized arguments: --" in line and line.endswith(hint)
