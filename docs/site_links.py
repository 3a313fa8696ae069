# SPDX-License-Identifier: Apache-2.0
"""Links of the site: pages and files of the repository that lie beside docs/."""

from __future__ import annotations

import os
import re
from pathlib import Path

_ROOT = Path(__file__).parents[1]
COPIED = {
    "CONTRIBUTING.md": "copied/contributing.md",
    "CHANGELOG.rst": "copied/changelog.rst",
    "SECURITY.md": "copied/security_policy.md",
    "benchmarks/README.md": "copied/benchmarks.md",
    **{f"models/{p.name}": f"copied/{p.name}" for p in sorted((_ROOT / "models").glob("*.md"))},
}
"""Pages of the repository that the site has too, and where."""

_PAGES = {**COPIED, "README.md": "index.md", "docs/README.md": "index.md"}
_LINK = re.compile(r"(?P<text>!?\[[^\]]*\])\((?P<target>[^)\s]+)\)")


def rewrite(text: str, path: Path, page: Path) -> str:
    """Return Markdown with its links as they must be on the site.

    Args:
        text: of a file of the repository.
        path: of the file, relative to the repository.
        page: where the site has it, relative to docs/.
    """

    def place(match: re.Match[str]) -> str:
        target, _, anchor = match["target"].partition("#")
        if not target or "://" in target or target.startswith("mailto:"):
            return match[0]
        wanted = Path(os.path.normpath(path.parent / target))
        if (_ROOT / wanted).is_dir():
            return f"`{match['text'][1:-1]}`" if "`" not in match["text"] else match["text"][1:-1]
        inside = _PAGES.get(wanted.as_posix())
        there = Path("docs", inside) if inside else wanted
        relative = os.path.relpath(there, Path("docs") / page.parent)
        return f"{match['text']}({relative}{'#' + anchor if anchor else ''})"

    return _LINK.sub(place, text)
