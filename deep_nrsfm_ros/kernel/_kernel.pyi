from typing import Any

FLOATS: int  # columns of a panel
DOUBLES: int  # to a multiple of which rows of doubles are filled up
MOST_LAYERS: int  # of a network
MAX_KEYPOINTS: int  # of a network
MAX_WIDTH: int  # of a dictionary of a network, in atoms

def plan(header: Any, floats: Any, doubles: Any, /) -> object: ...
def lift(
    plan: object, points: Any, confidence: Any, perspective: bool, /, *arrays: Any
) -> None: ...
def workers(header: Any, L: Any, L_inverse: Any, /) -> object: ...
def gradient(
    workers: object,
    cycle: float,
    weights: Any,
    x: Any,
    W: Any,
    mask: Any,
    T: Any,
    losses: Any,
    shapes: Any,
    gradient: Any,
    /,
) -> None: ...
def observe(
    data: bytes,
    messages: tuple[int, int],
    objects: tuple[int, int],
    steps: tuple[int, int],
    offsets: tuple[int, ...],
    farthest: float,
    least: float,
    points: Any,
    confidence: Any,
    /,
) -> None: ...
def choose_vectors(bytes: int, /) -> int: ...
