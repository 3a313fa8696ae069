# SPDX-License-Identifier: Apache-2.0
"""A context that a signal shuts down at the same time is no error."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import pytest
import rclpy

from deep_nrsfm_ros.node.shutdown import shut_down


class Late(nullcontext[None]):
    """rclpy's handle of a context, whose test comes a moment too early."""

    def __init__(self, handle: Any) -> None:
        super().__init__()
        self._handle = handle

    def ok(self) -> bool:
        return True

    def shutdown(self) -> None:
        self._handle.shutdown()


def test_a_signal_between_the_test_and_the_shutdown_is_no_error(domain: int) -> None:
    context: Any = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    shut_down(context)
    assert not context.ok()
    context._Context__context = Late(context._Context__context)
    with pytest.raises(RuntimeError, match="already called"):
        rclpy.try_shutdown(context=context)
    shut_down(context)
