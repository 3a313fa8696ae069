"""When a training ends before its last step, and which of its states is kept."""

from __future__ import annotations

from dataclasses import dataclass

from deep_nrsfm_ros.configuration import option


@dataclass(frozen=True)
class Limits:
    """Limits of a training.

    With `minutes` the learning rate follows the clock, so the same seed does not give the same
    model twice.

    `patience` is off unless asked for: with a learning rate that falls to zero most of what is
    gained in the second half is gained by its falling, and a stretch without improvement before
    that says nothing of what is to come. Who has steps to spare sets 0.2 or so.
    """

    minutes: float = option(
        0.0,
        "wall time after which the training ends, its learning rate having fallen to zero by "
        "then; 0: none",
        low=0.0,
        high=100_000.0,
    )
    patience: float = option(
        0.0,
        "share of the training without a better label-free quality after which it ends; 0: never",
        low=0.0,
        high=1.0,
    )
    max_frames: int = option(
        1_000_000,
        "most frames that the bags may hold; more are refused, before they fill the memory",
        low=10,
        high=1_000_000_000,
        read_only=True,
    )
    free_disk: float = option(
        100.0,
        "MB that must be free on the disk of the models when a training begins",
        low=0.0,
        high=1e9,
        read_only=True,
    )
    keep_best: bool = option(
        True, "keep the state with the best label-free quality, not the last one"
    )


WHOLE = Limits(keep_best=False)
"""All steps, and the state after the last of them."""
