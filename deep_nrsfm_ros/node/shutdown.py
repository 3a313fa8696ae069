# SPDX-License-Identifier: Apache-2.0
"""The end of a program: rclpy's context is shut down once, by the program or by a signal."""

from __future__ import annotations

from contextlib import suppress

import rclpy
from rclpy.context import Context


def shut_down(context: Context | None = None) -> None:
    """Shut a context down unless it is; None: the default one.

    rclpy's handler of SIGINT does the same in a thread of its own. `rclpy.try_shutdown` raises
    where that comes between its test and its call.
    """
    with suppress(RuntimeError):  # RCLError is one, and has no public name
        rclpy.try_shutdown(context=context)
