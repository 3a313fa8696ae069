"""A function of tensors as a program of torch's own, without Python between its operations."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable

import torch
from torch import Tensor

OFTEN = 100
"""Calls after which a function is traced: that costs what some hundred and fifty calls save."""

Function = Callable[..., tuple[Tensor, ...]]


class Traced:
    """A function of tensors, traced by torch once it has been called `OFTEN`.

    A step of training is some three hundred operations of a few microseconds; Python takes a fifth
    of it to tell torch of them. The trace does the same operations in the same order, so that its
    results are the same to the last bit. It holds for the shapes that it was made with, and others
    get one of their own; but whatever depends on the values of a tensor, or asks autograd, would
    stay as it was that once: such a function is not to be traced.
    """

    def __init__(self, function: Function) -> None:
        """Call `function` itself at first, then its trace."""
        self._function = function
        self._calls: Counter[tuple[torch.Size, ...]] = Counter()
        self._traces: dict[tuple[torch.Size, ...], Function] = {}

    def __call__(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Return what the function does of these tensors."""
        shapes = tuple(tensor.shape for tensor in tensors)
        if shapes not in self._traces:
            self._calls[shapes] += 1
            if self._calls[shapes] <= OFTEN:
                return self._function(*tensors)
            self._traces[shapes] = _trace(self._function, tensors)
        return self._traces[shapes](*tensors)


def _trace(function: Function, tensors: tuple[Tensor, ...]) -> Function:
    """Return a trace of what a function does of these tensors, or the function itself."""
    if not hasattr(torch.jit, "trace"):  # deprecated, but nothing else does without a compiler
        return function
    with warnings.catch_warnings(), torch.jit.optimized_execution(False):  # type: ignore[attr-defined]
        # Of its deprecation, and that shapes become constants.
        warnings.simplefilter("ignore")
        trace: Function = torch.jit.trace(function, tensors, check_trace=False)  # type: ignore[no-untyped-call]
        trace(*tensors)  # decides what executes it from now on: what does not optimise
    return trace
