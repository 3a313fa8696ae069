"""Names of topics, one `*` in which stands for any one part: `/humans/bodies/*/skeleton2d`."""

from __future__ import annotations

import re

WILDCARD = "*"


def match(pattern: str, topic: str) -> str | None:
    """Return what the `*` in `pattern` stands for in `topic`, None if the topic does not fit.

    Several are joined by "/"; a pattern without any fits itself alone, and stands for "".
    """
    expression = r"([^/]+)".join(map(re.escape, pattern.split(WILDCARD)))
    found = re.fullmatch(expression, topic)
    return None if found is None else "/".join(found.groups())
