# SPDX-License-Identifier: Apache-2.0
"""The generated pages are up to date, links of README and docs lead somewhere, the site builds."""

from __future__ import annotations

import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from deep_nrsfm_ros.layouts.layout_file import FIELDS
from deep_nrsfm_ros.layouts.presets import LAYOUTS
from deep_nrsfm_ros.messages.field_mapping import FieldMapping
from docs.generate import FOLDER, PAGES
from docs.site_links import rewrite

ROOT = Path(__file__).parents[1]
WRITTEN = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
LINK = re.compile(r"\]\(([^)\s]+)\)")


@pytest.mark.parametrize("name", PAGES)
def test_page_is_what_the_code_says(name: str) -> None:
    written = (FOLDER / name).read_text(encoding="utf-8")
    assert written == PAGES[name](), f"docs/reference/{name} is stale; run `make reference`"


def test_readme_is_two_screens_and_shows_what_it_does() -> None:
    lines = (ROOT / "README.md").read_text("utf-8").splitlines()
    assert len(lines) <= 130
    assert "docs/pictures/demo.webp" in "".join(lines[:5])
    assert (ROOT / "docs/pictures/demo.webp").stat().st_size < 3e6


@pytest.mark.parametrize("path", WRITTEN, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_lead_to_files(path: Path) -> None:
    if "copied" in path.parts:
        pytest.skip("written by the build of the site")
    for target in LINK.findall(path.read_text("utf-8")):
        if "://" not in target and not target.startswith(("#", "mailto:")):
            assert (path.parent / target.partition("#")[0]).exists(), f"{path}: {target}"


def test_links_are_moved_with_their_page() -> None:
    text = "[a](../benchmarks/README.md#x) [b](reference/layouts.md) [c](../deep_nrsfm_ros/kernel)"
    moved = rewrite(text, Path("docs/results.md"), Path("results.md"))
    assert moved == "[a](copied/benchmarks.md#x) [b](reference/layouts.md) `c`"
    assert rewrite(
        "[h](docs/people.md)", Path("CONTRIBUTING.md"), Path("copied/contributing.md")
    ) == ("[h](../people.md)")


def test_site_builds_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("furo", reason="pip install '.[docs]'")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "-q", "-b", "html", "docs", str(tmp_path / "site")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=170,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "site" / "operations" / "troubleshooting.html").is_file()


def test_an_object_file_of_the_package_fits_the_schema() -> None:
    schema = json.loads(PAGES["object.schema.json"]())
    assert list(schema["properties"]) == list(FIELDS)
    for path in (*ROOT.glob("config/layouts/*.yaml"), *ROOT.glob("*/layouts/presets/*.yaml")):
        fields = yaml.safe_load(path.read_text("utf-8"))
        assert set(schema["required"]) <= set(fields) <= set(schema["properties"])
        jsonschema.validate(fields, schema)


def test_a_mapping_of_the_package_fits_the_schema() -> None:
    schema = json.loads(PAGES["mapping.schema.json"]())
    fields = {field.name for field in dataclasses.fields(FieldMapping) if field.init}
    assert set(schema["properties"]) == fields
    for path in ROOT.glob("config/mappings/*.yaml"):
        jsonschema.validate(json.loads(json.dumps(yaml.safe_load(path.read_text()))), schema)


@pytest.mark.parametrize(
    ("page", "wrong"),
    [
        ("object", {"name": "dog"}),
        ("object", {"name": "dog", "keypoints": ["nose"], "edges": [["nose"]]}),
        ("object", {"name": "dog", "keypoints": ["nose"], "colour": "brown"}),
        ("mapping", {"type": "my_msgs/People", "x": "x"}),
        ("mapping", {"type": "People", "keypoints": "keypoints"}),
        ("mapping", {"type": "my_msgs/People", "keypoints": "k", "units": "metres"}),
        ("mapping", {"type": "my_msgs/People", "keypoints": "k", "max_confidence": 0}),
    ],
)
def test_wrong_files_do_not_fit_the_schema(page: str, wrong: dict[str, Any]) -> None:
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(wrong, json.loads(PAGES[f"{page}.schema.json"]()))


def test_each_layout_has_a_small_picture() -> None:
    pictures = {path.stem: path.stat().st_size for path in (FOLDER / "layouts").glob("*.png")}
    assert set(pictures) == set(LAYOUTS)
    assert max(pictures.values()) < 60_000
