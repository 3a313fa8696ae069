# SPDX-License-Identifier: Apache-2.0
"""Topic patterns: `*` stands for one part of a topic name, as in `/humans/bodies/*/skeleton2d`."""

from __future__ import annotations

import re

WILDCARD = "*"


def match(pattern: str, topic: str) -> str | None:
    """Return the part of `topic` that the `*` in `pattern` stands for; None: they do not match.

    The parts of several `*` are joined by "/". A pattern without `*` matches only itself; the
    result is then "".
    """
    expression = r"([^/]+)".join(map(re.escape, pattern.split(WILDCARD)))
    matched = re.fullmatch(expression, topic)
    return None if matched is None else "/".join(matched.groups())
