# SPDX-License-Identifier: Apache-2.0
"""Each source file names its licence in its first lines; REUSE.toml names that of the others."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = ("deep_nrsfm_ros", "benchmarks", "docs", "examples", "launch", "scripts", "test")
TAG = ": ".join(("SPDX-License-Identifier", "Apache-2.0"))  # `reuse lint` reads this file too
PYTHON, C = f"# {TAG}", f"/* {TAG} */"
HEADERS = {"": PYTHON, ".py": PYTHON, ".pyi": PYTHON, ".c": C, ".h": C}


def unlicensed(folder: Path) -> list[str]:
    """Return the source files below a folder whose header is not in the first two lines."""
    missing = []
    for path in sorted(folder.rglob("*")):
        if path.suffix in HEADERS and path.is_file():
            with path.open(encoding="utf-8") as file:
                if HEADERS[path.suffix] not in (line.rstrip() for line in islice(file, 2)):
                    missing.append(path.name)
    return missing


@pytest.mark.parametrize("room", ROOMS)
def test_each_source_file_names_its_licence(room: str) -> None:
    assert unlicensed(ROOT / room) == []


def test_a_file_without_a_licence_is_found(tmp_path: Path) -> None:
    (tmp_path / "licensed.py").write_text(f"{PYTHON}\npass\n")
    (tmp_path / "script").write_text(f"#!/usr/bin/env python3\n{PYTHON}\n")
    (tmp_path / "bare.py").write_text("pass\n")
    (tmp_path / "bare.c").write_text("int main(void) { return 0; }\n")
    assert unlicensed(tmp_path) == ["bare.c", "bare.py"]


def test_the_text_of_each_licence_is_there() -> None:
    texts = {path.stem: path.read_text("utf-8") for path in (ROOT / "LICENSES").iterdir()}
    assert set(texts) == {"Apache-2.0", "BSD-3-Clause"}
    assert texts["Apache-2.0"] == (ROOT / "LICENSE").read_text("utf-8")
