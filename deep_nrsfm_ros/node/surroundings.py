# SPDX-License-Identifier: Apache-2.0
"""What a lifter finds around it: a node of the same name, and the launch that started it."""

from __future__ import annotations

import os

from rclpy.node import Node

LAUNCH_PID = "DEEP_NRSFM_LAUNCH_PID"
"""Environment variable with the process id of the launch; the lifter ends when that has ended."""

_CHECKS = 8  # nodes that start at the same time discover each other within seconds


class NameCheck:
    """Looks for another node with the name of this one, in the first seconds after its start."""

    def __init__(self, node: Node) -> None:
        """Look for the name of `node`."""
        self._node, self._left = node, _CHECKS

    def __call__(self) -> str:
        """Return a warning if another node has the name, the first time; else "". Call it often."""
        if not self._left:
            return ""
        self._left -= 1
        own = (self._node.get_name(), self._node.get_namespace())
        if self._node.get_node_names_and_namespaces().count(own) < 2:
            return ""
        self._left = 0
        return (
            f"another node is named {self._node.get_fully_qualified_name()}: both publish on the "
            "same topics and answer the same services. End the other one, or start this one with "
            "-r __ns:=/NAMESPACE or -r __node:=NAME (a node that was killed is listed for up to "
            "20 s)"
        )


def launch_has_ended() -> bool:
    """Return whether the launch that started this process, as `LAUNCH_PID` says, has ended."""
    pid = os.environ.get(LAUNCH_PID, "")
    if not pid.isdecimal():
        return False
    try:
        os.kill(int(pid), 0)  # sends nothing
    except ProcessLookupError:
        return True
    except OSError:  # a process of another user
        return False
    return False
