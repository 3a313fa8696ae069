# SPDX-License-Identifier: Apache-2.0
"""Self-contained HTML pages: styles, scripts and data are inside, and data is escaped."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup


def render(template: str, styles: Sequence[str], scripts: Sequence[str], **values: Any) -> str:
    """Return a page from a template, with styles and scripts embedded.

    Args:
        template: file of this package, e.g. "report.html.j2".
        styles: .css files of this package.
        scripts: .js files of this package.
        values: variables of the template; they are escaped.
    """
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    return environment.from_string(_resource(template)).render(
        style=Markup("\n".join(map(_resource, styles))),
        script=Markup("\n".join(map(_resource, scripts))),
        **values,
    )


def embedded(value: Any) -> Markup:
    """Return a value as JSON for a script element, which the JSON cannot end."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c"))


def _resource(name: str) -> str:
    """Return the text of a file of this package."""
    return (files(__package__) / name).read_text(encoding="utf-8")
