# SPDX-License-Identifier: Apache-2.0
"""Checkpoints: named tensors in a file that is complete or does not exist.

The content comes from the methods `state` of `_Loop` (loop.py), `Trainer` (trainer.py),
`KnownShapesSource` (mirror.py) and `BestCheckpoint` (best_checkpoint.py).
"""

from __future__ import annotations

import os
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor


def write_checkpoint(path: Path, state: dict[str, Tensor]) -> None:
    """Write a state to a file; a crash leaves the file that was there."""
    partial = path.with_name(f"{path.name}.partial")
    save_file({name: tensor.contiguous().cpu() for name, tensor in state.items()}, partial)
    with partial.open("rb") as file:
        os.fsync(file.fileno())  # otherwise a power cut may leave an empty file
    partial.replace(path)


def read_checkpoint(path: Path) -> dict[str, Tensor]:
    """Return a saved state.

    Raises:
        ValueError: the file is damaged or missing.
    """
    try:
        return load_file(path)
    except (OSError, SafetensorError) as error:
        raise ValueError(f"checkpoint {path} cannot be read ({error}); delete it") from error
