# SPDX-License-Identifier: Apache-2.0
"""Synthetic furniture with random sizes: a substitute for the IKEA data of the paper.

A category has a few random lengths and angles, and arms or a footboard in half of its objects; real
furniture varies more. Metres and radians; x right, y front, z up; left and right are symmetric.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Row = tuple[Any, Any, Any]  # x, y, z of a point and its mirror image, each (n,) or a number


def _between(rng: np.random.Generator, n: int, *ranges: tuple[float, float]) -> list[Floats]:
    """Return a uniformly random (n,) for each (low, high)."""
    return [rng.uniform(low, high, n) for low, high in ranges]


def _points(n: int, *rows: Row) -> Floats:
    """Return the points (n, 2 len(rows), 3): each row on the right, then on the left."""
    both = [row for x, y, z in rows for row in ((x, y, z), (-x, y, z))]
    return np.array([[np.broadcast_to(v, n) for v in row] for row in both]).transpose(2, 0, 1)


def table(rng: np.random.Generator, n: int) -> Floats:
    """Return n tables (n, 12, 3): corners of the top, tops and feet of the legs."""
    width, depth, height = _between(rng, n, (0.25, 1.1), (0.25, 0.6), (0.4, 1.1))
    inset, splay, board = _between(rng, n, (0.2, 1.0), (-0.1, 0.3), (0.02, 0.15))
    x, y = inset * width, inset * depth
    return _points(
        n,
        *((width, side * depth, height) for side in (1, -1)),
        *((x, side * y, height - board) for side in (1, -1)),
        *((x + splay, side * (y + splay), 0) for side in (1, -1)),
    )


def chair(rng: np.random.Generator, n: int) -> Floats:
    """Return n chairs (n, 14, 3): seat, feet, top of the back and arms, half of them without."""
    front, back, depth, height = _between(
        rng, n, (0.2, 0.32), (0.15, 0.3), (0.18, 0.3), (0.35, 0.75)
    )
    top, recline, splay = _between(rng, n, (0.25, 0.75), (0.0, 0.7), (-0.05, 0.12))
    arm, reach = _between(rng, n, (0.1, 0.28), (0.2, 1.0))
    arm *= rng.random(n) < 0.5
    return _points(
        n,
        (front, depth, height),
        (back, -depth, height),
        (front + splay, depth + splay, 0),
        (back + splay, -depth - splay, 0),
        (back, -depth - top * np.sin(recline), height + top * np.cos(recline)),
        (front, -depth + 2 * depth * reach, height + arm),
        (front, -depth, height + arm),
    )


def sofa(rng: np.random.Generator, n: int) -> Floats:
    """Return n sofas (n, 14, 3): seat, feet, top of the back and arms."""
    width, depth, height, leg = _between(rng, n, (0.5, 1.3), (0.3, 0.55), (0.3, 0.5), (0.0, 0.2))
    top, recline, arm, thick = _between(rng, n, (0.25, 0.6), (0.0, 0.7), (0.1, 0.3), (0.05, 0.3))
    return _points(
        n,
        (width, depth, height),
        (width, -depth, height),
        (width + thick, depth, leg),
        (width + thick, -depth, leg),
        (width, -depth - top * np.sin(recline), height + top * np.cos(recline)),
        (width + thick, depth, height + arm),
        (width + thick, -depth, height + arm),
    )


def bed(rng: np.random.Generator, n: int) -> Floats:
    """Return n beds (n, 12, 3): mattress, feet, tops of headboard and, for half, footboard."""
    width, length, height = _between(rng, n, (0.4, 1.0), (0.9, 1.1), (0.3, 0.7))
    head, foot, inset = _between(rng, n, (0.1, 0.9), (0.1, 0.4), (0.85, 1.0))
    foot *= rng.random(n) < 0.5
    return _points(
        n,
        *((width, side * length, height) for side in (1, -1)),
        *((inset * width, side * inset * length, 0) for side in (1, -1)),
        (width, -length, height + head),
        (width, length, height + foot),
    )


CATEGORIES: dict[str, Callable[[np.random.Generator, int], Floats]] = {
    "bed": bed,
    "chair": chair,
    "sofa": sofa,
    "table": table,
}
