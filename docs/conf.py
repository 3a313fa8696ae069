# SPDX-License-Identifier: Apache-2.0
"""Sphinx configuration: `make docs` builds the site with warnings as errors."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))
from deep_nrsfm_ros import __version__
from docs.site_links import COPIED, rewrite

project = "deep_nrsfm_ros"
author = "deep_nrsfm_ros maintainers"
copyright = "deep_nrsfm_ros maintainers, Apache-2.0"
version = release = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
]
exclude_patterns = ["README.md", "_build", "__pycache__"]
html_theme = "furo"
html_title = f"deep_nrsfm_ros {__version__}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_extra_path = ["reference/object.schema.json", "reference/mapping.schema.json"]

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_mock_imports = [
    *("torch", "rclpy", "rosbags", "lap"),
    *("sensor_msgs", "std_msgs", "geometry_msgs", "visualization_msgs", "diagnostic_msgs"),
]
napoleon_google_docstring = True
napoleon_use_ivar = True

# `sphinx-build -b linkcheck`: these need a login, or exist only where the package runs.
linkcheck_ignore = [r"http://127\.0\.0\.1.*", r"http://download\.ros\.org/schema/.*"]
linkcheck_timeout = 20
linkcheck_retries = 2
linkcheck_anchors = False

_DOCS = Path(__file__).parent
_ROOT = _DOCS.parent


def _copy_pages(_: Any) -> None:
    """Copy the pages that lie beside docs/ in the repository into docs/copied/."""
    for name, page in COPIED.items():
        copy = _DOCS / page
        copy.parent.mkdir(exist_ok=True)
        copy.write_text(rewrite((_ROOT / name).read_text("utf-8"), Path(name), Path(page)), "utf-8")


def _read_page(_: Any, name: str, source: list[str]) -> None:
    """Point the links of a page that leave docs/ to where the site has their target."""
    page = Path(f"{name}.md")
    if page not in map(Path, COPIED.values()):
        source[0] = rewrite(source[0], Path("docs") / page, page)
    if name == "index":
        pages = [path.stem for path in sorted(_DOCS.glob("*.md"))]
        pages += [Path(page).with_suffix("").as_posix() for page in COPIED.values()]
        more = [page for page in pages if page not in ("README", "index", *source[0].split())]
        if more:  # pages that index.md does not place
            listed = "\n".join(more)
            source[0] += f"\n```{{toctree}}\n:caption: More\n:maxdepth: 1\n{listed}\n```\n"


def setup(app: Any) -> None:
    """Connect the functions above."""
    app.connect("builder-inited", _copy_pages)
    app.connect("source-read", _read_page)
