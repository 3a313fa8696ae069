# SPDX-License-Identifier: Apache-2.0
"""Files that a public host reads are valid by its schemas: workflows, forms, updates, citation."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
GITHUB = ROOT / ".github"
FILES = {
    "github-workflows": sorted((GITHUB / "workflows").glob("*.yml")),
    "github-issue-forms": sorted((GITHUB / "ISSUE_TEMPLATE").glob("*.yml")),
    "dependabot": [GITHUB / "dependabot.yml"],
    "citation-file-format": [ROOT / "CITATION.cff"],
}


def exit_code(schema: str, files: list[Path]) -> int:
    """Return 0 if the files are valid by a schema that check-jsonschema carries."""
    check = pytest.importorskip("check_jsonschema")
    with pytest.raises(SystemExit) as end:
        check.main(["--quiet", "--builtin-schema", f"vendor.{schema}", *map(str, files)])
    assert isinstance(end.value.code, int)
    return end.value.code


@pytest.mark.parametrize("schema", FILES)
def test_files_are_valid(schema: str) -> None:
    assert FILES[schema] and exit_code(schema, FILES[schema]) == 0


def test_a_wrong_file_is_refused(tmp_path: Path) -> None:
    wrong = tmp_path / "workflow.yml"
    wrong.write_text("on: push\njobs: {test: {runs-on: ubuntu-latest, step: []}}\n")
    assert exit_code("github-workflows", [wrong]) != 0


def test_the_citation_has_the_version_of_the_package() -> None:
    version = (ROOT / "package.xml").read_text().split("<version>")[1].split("<")[0]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
