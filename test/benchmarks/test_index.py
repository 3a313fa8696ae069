# SPDX-License-Identifier: Apache-2.0
"""The index of the benchmarks names every program, and each program explains its options."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "benchmarks"
NODES = {"speed/relay_node.py"}
"""Programs that are started by benchmarks and are none themselves."""


def programs() -> list[str]:
    """Return the files with a `__main__` guard, relative to benchmarks/."""
    return sorted(
        path.relative_to(FOLDER).as_posix()
        for path in FOLDER.rglob("*.py")
        if 'if __name__ == "__main__":' in path.read_text()
    )


def index() -> list[tuple[str, str]]:
    """Return file and command of each program that the index names."""
    rows = []
    folder = ""
    for line in (FOLDER / "README.md").read_text().splitlines():
        if heading := re.match(r"## (\w+/)", line):
            folder = heading[1]
        elif line.startswith("## "):
            folder = ""
        if folder and (row := re.match(r"\| `(\w+\.py)` \|.*\| `([^`]+)` \|$", line)):
            rows.append((folder + row[1], row[2]))
    return rows


def test_the_index_names_every_program_and_no_other() -> None:
    assert sorted(file for file, _ in index()) == sorted(set(programs()) - NODES)


def test_each_command_of_the_index_runs_its_file() -> None:
    for file, command in index():
        module = "benchmarks." + file.removesuffix(".py").replace("/", ".")
        assert command.startswith(f"python -m {module}"), file


def test_the_makefile_runs_programs_that_exist() -> None:
    text = (ROOT / "Makefile").read_text().replace("\\\n", " ")
    names = re.findall(r"^(?:BENCHMARKS|SPEED) := (.*)$", text, re.MULTILINE)
    files = {f"{name.replace('.', '/')}.py" for line in names for name in line.split()}
    assert files
    assert files <= set(programs())


@pytest.mark.parametrize("file", sorted(set(programs()) - NODES))
def test_each_program_explains_its_options(file: str, capsys: pytest.CaptureFixture[str]) -> None:
    module = importlib.import_module("benchmarks." + file.removesuffix(".py").replace("/", "."))
    with pytest.raises(SystemExit) as ended:
        module.main(["--help"])
    assert ended.value.code == 0
    assert "usage:" in capsys.readouterr().out
