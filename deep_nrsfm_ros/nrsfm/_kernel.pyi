from typing import Any

FLOATS: int  # columns of a panel
DOUBLES: int  # to a multiple of which rows of doubles are filled up

def plan(header: Any, floats: Any, doubles: Any, /) -> object: ...
def lift(
    plan: object, points: Any, confidence: Any, perspective: bool, /, *arrays: Any
) -> None: ...
def choose_vectors(bytes: int, /) -> int: ...
