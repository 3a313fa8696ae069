"""HTML pages that stand alone: everything they need is inside, and data never becomes markup."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup


def render(template: str, styles: Sequence[str], scripts: Sequence[str], **values: Any) -> str:
    """Return a template of this package with `style` and `script` from files of this package."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    return environment.from_string(_resource(template)).render(
        style=Markup("\n".join(map(_resource, styles))),
        script=Markup("\n".join(map(_resource, scripts))),
        **values,
    )


def embedded(value: Any) -> Markup:
    """Return JSON that cannot end the script element it stands in."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c"))


def _resource(name: str) -> str:
    """Return a file of this package."""
    return (files(__package__) / name).read_text(encoding="utf-8")
