"""The generated reference pages are up to date, and the README names them."""

from __future__ import annotations

from pathlib import Path

import pytest

from deep_nrsfm_ros.layouts.presets import LAYOUTS
from docs.generate import FOLDER, PAGES

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", PAGES)
def test_page_is_what_the_code_says(name: str) -> None:
    written = (FOLDER / name).read_text(encoding="utf-8")
    assert written == PAGES[name](), f"docs/reference/{name} is stale; run `make reference`"


@pytest.mark.parametrize("name", PAGES)
def test_readme_links_the_page(name: str) -> None:
    assert f"(docs/reference/{name})" in README


def test_each_layout_has_a_small_picture() -> None:
    pictures = {path.stem: path.stat().st_size for path in (FOLDER / "layouts").glob("*.png")}
    assert set(pictures) == set(LAYOUTS)
    assert max(pictures.values()) < 60_000
