# SPDX-License-Identifier: Apache-2.0
"""Names that may be meant by one that does not exist."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

_MOST = 3


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """Return "did you mean 'a' or 'b'?" of the names like `name`, nearest first; "" if none is.

    Upper and lower case count as the same.
    """
    by_lower = {each.lower(): each for each in names}
    near = difflib.get_close_matches(name.lower(), by_lower, _MOST)
    return f"did you mean {' or '.join(repr(by_lower[each]) for each in near)}?" if near else ""
