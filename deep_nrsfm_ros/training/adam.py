# SPDX-License-Identifier: Apache-2.0
"""Adam for one tensor of weights."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-8


class Adam:
    """Adam for one tensor; computes what `torch.optim.Adam([weights], fused=True)` computes.

    Every optimiser of `torch.optim` imports the compiler of torch, `torch._dynamo`, when it is
    constructed. The import takes two seconds of CPU time at the start of each training process.

    Attributes:
        learning_rate: of the last step; 0 before the first one.
        moments: `step` (), the number of steps; `exp_avg` (w,) and `exp_avg_sq` (w,), the moving
            means of the gradient and of its square.

    Source: Kingma and Ba, Adam: A Method for Stochastic Optimization, algorithm 1.
    """

    def __init__(self, weights: Tensor) -> None:
        """Start with moments of zero.

        Args:
            weights: (w,) float32; `update` changes them in place.
        """
        self.weights = weights
        self.learning_rate = 0.0
        self.moments = {
            "step": torch.zeros((), dtype=torch.float32, device=weights.device),
            "exp_avg": torch.zeros_like(weights),
            "exp_avg_sq": torch.zeros_like(weights),
        }

    @torch.no_grad()
    def update(self, gradient: Tensor, learning_rate: float) -> None:
        """Take one step along the gradient (w,)."""
        self.learning_rate = learning_rate
        self.moments["step"] += 1
        torch._fused_adam_(
            *([self.weights], [gradient]),
            *([self.moments["exp_avg"]], [self.moments["exp_avg_sq"]], [], [self.moments["step"]]),
            lr=learning_rate,
            beta1=_BETA1,
            beta2=_BETA2,
            weight_decay=0.0,
            eps=_EPSILON,
            amsgrad=False,
            maximize=False,
        )

    def restore(self, moments: Mapping[str, Tensor]) -> None:
        """Take over saved moments; those that are not among them keep their values."""
        take_over(self.moments, moments)


@torch.no_grad()
def take_over(own: Mapping[str, Tensor], saved: Mapping[str, Tensor]) -> None:
    """Copy saved tensors to those of the same name; others keep their values."""
    for name in own.keys() & saved.keys():
        own[name].copy_(saved[name])
