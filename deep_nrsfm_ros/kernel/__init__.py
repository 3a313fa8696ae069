# SPDX-License-Identifier: Apache-2.0
"""The compiled kernel: the network's passes, the correction and the decoding of messages in C.

All other rooms import the kernel from here: `_kernel` is the C module, None where there was no C
compiler at installation. NumPy and torch compute the same without it, some ten and three times
slower.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from deep_nrsfm_ros.nrsfm.network import Network

REQUIRED = "DEEP_NRSFM_REQUIRE_KERNEL"  # environment variable: 1 makes a missing kernel an error

try:
    from deep_nrsfm_ros.kernel import _kernel
except ImportError as missing:
    if os.environ.get(REQUIRED) == "1":
        raise ImportError(
            f"{REQUIRED}=1, but the compiled kernel cannot be imported ({missing}): install a C "
            "compiler (apt-get install gcc python3-dev), then the package again"
        ) from missing
    _kernel = None  # type: ignore[assignment]

AVAILABLE = _kernel is not None


def supports(network: Network) -> bool:
    """Return whether the kernel is available and computes a network of this architecture.

    It computes the default variant (`Architecture.is_default_variant`) within its limits of
    dictionaries, atoms and keypoints; other networks are left to NumPy and torch.
    """
    architecture = network.architecture
    return (
        AVAILABLE
        and architecture.is_default_variant
        and len(architecture.widths) <= _kernel.MAX_LAYERS
        and max(architecture.widths) <= _kernel.MAX_WIDTH
        and network.p <= _kernel.MAX_KEYPOINTS
    )
