# SPDX-License-Identifier: Apache-2.0
"""Tables in several encodings, with comments, and with several marks between their cells."""

from __future__ import annotations

from pathlib import Path

import pytest

from deep_nrsfm_ros.data.formats.builder import KeypointFileError
from deep_nrsfm_ros.data.formats.table_text import table_rows

TABLE = "nose_x,nose_y\n1.5,2\n\n3,4\n"
ROWS = [["nose_x", "nose_y"], ["1.5", "2"], [], ["3", "4"]]


def rows(path: Path, data: str | bytes) -> tuple[list[list[str]], list[int], list[str]]:
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    comments: list[str] = []
    with table_rows(path, comments) as found:
        lines, cells = zip(*found, strict=True)
    return list(cells), list(lines), comments


def test_plain(tmp_path: Path) -> None:
    assert rows(tmp_path / "a", TABLE) == (ROWS, [1, 2, 3, 4], [])


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
def test_encodings(tmp_path: Path, encoding: str) -> None:
    assert rows(tmp_path / "a", TABLE.encode(encoding))[0] == ROWS


def test_latin_1(tmp_path: Path) -> None:
    assert rows(tmp_path / "a", "zeit_µs,x\n1,2\n".encode("latin-1"))[0][0] == ["zeit_µs", "x"]


@pytest.mark.parametrize("mark", [";", "\t", "|", " ", "  "])
def test_marks_between_cells(tmp_path: Path, mark: str) -> None:
    text = TABLE.replace(",", mark).replace("1.5", "1,5")
    assert rows(tmp_path / "a", text)[0] == ROWS


def test_lines_before_the_header(tmp_path: Path) -> None:
    found = rows(tmp_path / "a", "\n# fps=10\nsep=;\n" + TABLE.replace(",", ";"))
    assert found == (ROWS, [4, 5, 6, 7], ["fps=10"])
    found = rows(tmp_path / "a", "# nose_x,nose_y\n1.5,2\n\n# the end\n3,4\n")
    assert found[0] == ROWS and found[1] == [1, 2, 3, 5]
    with pytest.raises(KeypointFileError, match="the file is empty"):
        rows(tmp_path / "a", "\n# nothing\n,,\n")
