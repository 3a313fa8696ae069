# SPDX-License-Identifier: Apache-2.0
"""Metres from a person's height."""

from __future__ import annotations

TRUNK_SHARE = 0.5 / 1.75
"""Length of the trunk, from neck to mid-hip, relative to a person's height."""


def trunk_length(person_height: float) -> float:
    """Return the distance from neck to mid-hip of a person, in the unit of the height."""
    return TRUNK_SHARE * person_height
