# SPDX-License-Identifier: Apache-2.0
"""The node as a managed node: the states and transitions of ROS 2's lifecycle."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleNodeMixin
from rclpy.node import Node

_SHUTTING_DOWN = "shutting down"


class Stages(Protocol):
    """What the transitions of a managed node do.

    Each raises an exception with the reason where it cannot be done, and leaves the node as it was.
    """

    def configure(self) -> None:
        """Load and create everything but the input."""

    def activate(self) -> None:
        """Receive the input."""

    def deactivate(self) -> None:
        """Stop receiving the input."""

    def clean_up(self) -> None:
        """Release what `configure` has created."""


class Lifecycle(LifecycleNodeMixin):
    """The state machine of a node, with its services and its topic of transitions.

    A state machine beside the node, and not a base class of it, because a parameter decides whether
    there is one. `LifecycleNodeMixin` needs the three attributes of a Node that are set here.
    """

    def __init__(self, node: Node, stages: Stages, error_text: Callable[[Exception], str]) -> None:
        """Offer the services of a managed node, in the state `unconfigured`.

        Args:
            node: owns them.
            stages: what the transitions do.
            error_text: returns the reason of a failure.
        """
        self.handle, self._services = node.handle, node._services
        self.default_callback_group = node.default_callback_group
        super().__init__()
        self._log, self._stages, self._error_text = node.get_logger(), stages, error_text
        self.problem = ""
        change_state = self._service_change_state.callback

        def answer(
            request: ChangeState.Request, response: ChangeState.Response
        ) -> ChangeState.Response:
            """Refuse a transition that there is not; rclpy would end the node."""
            try:
                change_state(request, response)
            except Exception as error:
                asked = request.transition.label or request.transition.id
                self._log.error(f"no transition {asked} from the state {self.state!r}: {error}")
                response.success = False
            return response

        self._service_change_state.callback = answer

    @property
    def state(self) -> str:
        """The state: unconfigured, inactive, active or finalized."""
        return str(self._state_machine.current_state[1])

    def on_configure(self, _: LifecycleState) -> Any:
        """Configure."""
        return self._attempt("configure", self._stages.configure)

    def on_activate(self, _: LifecycleState) -> Any:
        """Activate."""
        return self._attempt("activate", self._stages.activate)

    def on_deactivate(self, _: LifecycleState) -> Any:
        """Deactivate."""
        return self._attempt("deactivate", self._stages.deactivate)

    def on_cleanup(self, _: LifecycleState) -> Any:
        """Clean up."""
        return self._attempt("clean up", self._stages.clean_up)

    def on_shutdown(self, state: LifecycleState) -> Any:
        """Release everything, from any state."""
        if state.label == "active":
            self._attempt(_SHUTTING_DOWN, self._stages.deactivate)
        if state.label in ("active", "inactive"):
            self._attempt(_SHUTTING_DOWN, self._stages.clean_up)
        return TransitionCallbackReturn.SUCCESS

    def _attempt(self, transition: str, stage: Callable[[], None]) -> Any:
        """Do what a transition does; log why it fails."""
        self.problem = ""
        try:
            stage()
        except Exception as error:  # a wrong parameter must not end the node
            self.problem = f"cannot {transition}: {self._error_text(error)}"
            self._log.error(self.problem)
            return TransitionCallbackReturn.FAILURE
        self._log.info(f"{transition}: done")
        return TransitionCallbackReturn.SUCCESS
