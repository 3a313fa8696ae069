# SPDX-License-Identifier: Apache-2.0
"""The text of a table: its encoding, its comments, and the character between its cells."""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import IO

from deep_nrsfm_ros.data.formats.builder import KeypointFileError

_DECIMAL_COMMA = re.compile(r"^(\s*[-+]?\d+),(\d+)")
_SEPARATOR = re.compile(r'"?sep=(.)"?\s*', re.IGNORECASE)  # a line that Excel writes and reads
_BLANK = ' ,;|\t\r\n"'
_BLOCK = 1 << 20  # bytes that are decoded at once

Row = tuple[int, list[str]]
"""Line in the file, and the cells of a row; [] for an empty line."""


@contextmanager
def table_rows(path: Path, comments: list[str]) -> Iterator[Iterator[Row]]:
    """Open a table; give its rows from its header on.

    Args:
        path: the file, in UTF-8, UTF-16 or Latin-1.
        comments: gets the lines before the header that begin with # or %.

    Raises:
        KeypointFileError: it has no header.
    """
    encoding = _encoding(path)
    with path.open(encoding=encoding, errors="replace", newline="") as file:
        line, skipped, delimiter = _header(file, comments)
        if not delimiter:
            counted = max(",;\t|", key=line.count)
            delimiter = counted if counted in line else " "
        lines = [line]
        # np.savetxt writes # before the header.
        if comments and _follows(comments[-1], line, delimiter):
            lines.insert(0, comments.pop() + "\n")
            skipped -= 1
        yield _cells(chain(lines, file), delimiter, skipped)


def _cells(lines: Iterable[str], delimiter: str, skipped: int) -> Iterator[Row]:
    """Yield the rows of lines."""
    if delimiter == " ":
        rows: Iterator[Row] = ((i, line.split()) for i, line in enumerate(lines, 1))
    else:
        reader = csv.reader(lines, delimiter=delimiter)
        rows = ((reader.line_num, row) for row in reader)
    for line, row in rows:
        if row and row[0].lstrip()[:1] in ("#", "%") and line > 1:
            continue
        if delimiter != ",":  # spreadsheets of half of Europe write 1,5 for 1.5
            row = [_DECIMAL_COMMA.sub(r"\1.\2", cell) if "," in cell else cell for cell in row]
        yield skipped + line, row


def _header(file: IO[str], comments: list[str]) -> tuple[str, int, str]:
    """Return the first line that is none of comment and blank, and the lines before it.

    Args:
        file: at its start.
        comments: gets the comments.

    Returns:
        The line, the number of lines before it, and the delimiter that one of them names; "" = no
        line names one.
    """
    delimiter = ""
    for skipped, line in enumerate(file):
        if found := _SEPARATOR.fullmatch(line):
            delimiter = found[1]
        elif line.lstrip()[:1] in ("#", "%") and line.strip(_BLANK):
            comments.append(line.strip().lstrip("#% "))
        elif line.strip(_BLANK):
            return line, skipped, delimiter
    raise KeypointFileError("the file is empty")


def _follows(head: str, line: str, delimiter: str) -> bool:
    """Return whether a line has as many cells as a header, and mostly numbers."""
    names, cells = head.split(delimiter), line.split(delimiter)
    numbers = sum(is_number(cell) for cell in cells)
    return len(names) == len(cells) > 1 and 2 * numbers > len(cells)


def is_number(cell: str) -> bool:
    """Return whether a cell is a number, with a point or a comma."""
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def _encoding(path: Path) -> str:
    """Return the encoding of a file: by its mark, else UTF-8 if all of it is that."""
    decoder = codecs.getincrementaldecoder("utf-8")()
    with path.open("rb") as file:
        start = file.read(64)
        if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            return "utf-16"
        if b"\0" in start:
            return "utf-16-be" if start[:1] == b"\0" else "utf-16-le"
        file.seek(0)
        try:
            while block := file.read(_BLOCK):
                decoder.decode(block)
            decoder.decode(b"", final=True)
        except UnicodeDecodeError:
            return "cp1252"
    return "utf-8-sig"
