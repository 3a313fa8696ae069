# SPDX-License-Identifier: Apache-2.0
"""Commands of the README and the documentation have options and parameters that exist."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from docs.generate import PARSERS, parameter_names

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    *(p for p in sorted((ROOT / "docs").rglob("*.md")) if "copied" not in p.parts),
    *sorted((ROOT / "models").glob("*.md")),
]
CALL = re.compile(r"(?:deep-nrsfm|ros2 run deep_nrsfm_ros) (\w+)(.*)")
OF_DETECTOR = {"source", "rate", "frame_id", "listeners", "smooth", "detect", "selfie"}


def commands() -> Iterator[tuple[str, str, list[str]]]:
    """Yield place, program and arguments of each documented command."""
    for page in PAGES:
        text = page.read_text("utf-8").replace("\\\n", " ")
        for line in re.findall(r"^ {4,}(?!\|)(.*)$", text, re.MULTILINE):
            line = re.sub(r"\s{2,}#.*$", "", line).split(" && ")[0]
            if (call := CALL.search(line)) and "..." not in line:
                place = f"{page.relative_to(ROOT)}: {line.strip()[:70]}"
                yield place, call[1], shlex.split(call[2])


COMMANDS = list(commands())


def test_commands_are_found() -> None:
    assert len(COMMANDS) > 30
    assert {"lift", "train", "replay", "lifter", "evaluate", "demo"} <= {c[1] for c in COMMANDS}


@pytest.mark.parametrize(("name", "words"), [c[1:] for c in COMMANDS], ids=[c[0] for c in COMMANDS])
def test_documented_command_can_be_read(name: str, words: list[str]) -> None:
    if name in PARSERS:
        PARSERS[name]().parse_args(words)  # it exits on an unknown option
        return
    assert name in ("lifter", "mediapipe_detector")
    known = OF_DETECTOR if name == "mediapipe_detector" else parameter_names()
    for flag, word in zip(words, words[1:], strict=False):
        if flag == "-p":
            parameter = word.partition(":=")[0]
            assert parameter in known or parameter.startswith("qos_overrides."), parameter
