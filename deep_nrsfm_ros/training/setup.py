# SPDX-License-Identifier: Apache-2.0
"""What a training starts from and how long it goes on, besides data and preset."""

from __future__ import annotations

from dataclasses import dataclass

from deep_nrsfm_ros.nrsfm.layout_loss import LayoutLoss
from deep_nrsfm_ros.nrsfm.network import Network
from deep_nrsfm_ros.training.distributed import ALONE, ProcessGroup
from deep_nrsfm_ros.training.limb_exchange import LimbExchange
from deep_nrsfm_ros.training.limits import WHOLE, Limits


@dataclass(frozen=True)
class Setup:
    """What a training starts from and how long it goes on, besides data and preset.

    Attributes:
        start: network to begin with, of the preset's architecture (see `fine_tuning`); None
            begins with random networks, of which the screening chooses one.
        layout_loss: loss of the keypoint layout that is added to the recipe's; None is none.
        limb_exchange: the limbs of the keypoint layout, which `Recipe.limb_exchange` needs; None:
            it has none.
        limits: when the training ends before its last step, and which state it keeps.
        group: the processes that share the training.
        own_frames: whether each process has frames of its own; else all have all frames.
    """

    start: Network | None = None
    layout_loss: LayoutLoss | None = None
    limb_exchange: LimbExchange | None = None
    limits: Limits = WHOLE
    group: ProcessGroup = ALONE
    own_frames: bool = False


DEFAULT_SETUP = Setup()
