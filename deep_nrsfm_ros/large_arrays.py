# SPDX-License-Identifier: Apache-2.0
"""Large arrays in temporary files: memory holds the part that is in use, the file the whole."""

from __future__ import annotations

import mmap
import os
import tempfile
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from deep_nrsfm_ros.batched import slices

LARGE = 1 << 22
"""Bytes from which on an array is kept in a file."""
_RELEASED = 64  # slices that are copied before their pages are taken out of memory


def empty(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return an array of undefined content; a large one is in a temporary file.

    The file has no name, so that nothing remains of it, however the program ends. It is in the
    folder that the variable TMPDIR names, usually /tmp. Where there is no room, the array is in
    memory.

    Args:
        shape: of the array.
        dtype: of the array.
    """
    size = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
    if size < max(LARGE, 1):
        return np.empty(shape, dtype)
    try:
        with tempfile.TemporaryFile() as file:
            # A write to a file without room would end the program, so the room is taken first.
            os.posix_fallocate(file.fileno(), 0, size)
            pages = mmap.mmap(file.fileno(), size)
    except (OSError, AttributeError):  # no room, or a system without posix_fallocate
        return np.empty(shape, dtype)
    return np.frombuffer(pages, dtype).reshape(shape)


def take(array: NDArray[Any], rows: NDArray[np.int64]) -> NDArray[Any]:
    """Return rows of an array as another one, which is in a file if it is large."""
    result = empty((len(rows), *array.shape[1:]), array.dtype)
    for done, part in enumerate(slices(len(rows))):
        result[part] = array[rows[part]]
        if done % _RELEASED == _RELEASED - 1:
            release((array, result))
    return result


def concatenated(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return arrays one after the other as one, which is in a file if it is large.

    Each is taken out of memory when it is copied, if it is one of `empty`.

    Args:
        arrays: at least one.
    """
    if len(arrays) == 1:
        return arrays[0]
    total = sum(len(array) for array in arrays)
    result, start = empty((total, *arrays[0].shape[1:]), arrays[0].dtype), 0
    for array in arrays:
        result[start : start + len(array)] = array
        start += len(array)
        release((array, result))
    return result


def release(arrays: Iterable[NDArray[Any]]) -> None:
    """Take arrays of `empty` out of memory; they are read from their files when used again."""
    for array in arrays:
        pages = array
        while isinstance(pages, np.ndarray) and pages.base is not None:
            pages = pages.base
        pages = pages.obj if isinstance(pages, memoryview) else pages
        if isinstance(pages, mmap.mmap):
            pages.madvise(mmap.MADV_DONTNEED)
