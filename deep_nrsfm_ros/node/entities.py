# SPDX-License-Identifier: Apache-2.0
"""Publishers, subscriptions, services and timers of a node that are destroyed together."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node


class Entities:
    """What a node creates from now on."""

    def __init__(self, node: Node) -> None:
        """Remember what there is."""
        self._node = node
        # With the entities themselves, so that no later one has the id of an earlier one.
        self._before = {id(entity): entity for kind, _ in self._kinds() for entity in kind}

    def destroy(self) -> None:
        """Destroy what has been created since."""
        for entities, destroy in self._kinds():
            for entity in entities:
                if id(entity) not in self._before:
                    destroy(entity)

    def _kinds(self) -> list[tuple[list[Any], Any]]:
        """Return the entities of each kind, and what destroys one."""
        node = self._node
        return [
            ([*node.subscriptions], node.destroy_subscription),
            ([*node.timers], node.destroy_timer),
            ([*node.services], node.destroy_service),
            ([*node.clients], node.destroy_client),
            ([*node.guards], node.destroy_guard_condition),
            ([*node.publishers], node.destroy_publisher),
        ]
