# SPDX-License-Identifier: Apache-2.0
"""The lifter as a managed node, over real DDS."""

from __future__ import annotations

import gc
import sys
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from lifecycle_msgs.msg import State, Transition, TransitionEvent
from lifecycle_msgs.srv import (
    ChangeState,
    GetAvailableStates,
    GetAvailableTransitions,
    GetState,
)
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2

from deep_nrsfm_ros.messages.decoding import POINT_CLOUD
from deep_nrsfm_ros.node import lifter
from test.node.conftest import Client, LifterProcess, lifters, own_domain, write_models
from test.node.test_lifter import cloud, pixels

ERROR = b"\x02"


class Manager:
    """Asks for the transitions of a managed lifter, as nav2's lifecycle manager does."""

    def __init__(self, process: LifterProcess, client: Client) -> None:
        self.process, self.client = process, client
        client.listen("/lifter/transition_event", TransitionEvent)
        self._clients: dict[str, Any] = {}
        self._publisher = client.node.create_publisher(PointCloud2, "keypoints", 10)

    def ask(self, name: str, kind: Any, request: Any) -> Any:
        """Return the answer of a service of the lifter."""
        client = self._clients.get(name)
        if client is None:
            client = self.client.node.create_client(kind, f"/lifter/{name}")
            self._clients[name] = client
            self.client.wait(client.service_is_ready, name)
        future = client.call_async(request)
        self.client.wait(future.done, f"an answer of {name}")
        return future.result()

    def change(self, label: str = "", number: int = 0) -> bool:
        """Ask for a transition; return whether it has happened."""
        request = ChangeState.Request(transition=Transition(id=number, label=label))
        return bool(self.ask("change_state", ChangeState, request).success)

    @property
    def state(self) -> str:
        return str(self.ask("get_state", GetState, GetState.Request()).current_state.label)

    def topics(self) -> set[str]:
        """Return what the lifter publishes, below its name."""
        node = self.client.node
        names = node.get_publisher_names_and_types_by_node("lifter", "/")
        return {name for name, _ in names if name.startswith("/lifter/")}

    def answered(self, seconds: float = 0.4) -> bool:
        """Publish keypoints for a while; return whether there are points."""
        points = self.client.heard["/lifter/points"]
        points.clear()
        message = cloud(pixels(1))
        timer = self.client.node.create_timer(0.05, lambda: self._publisher.publish(message))
        try:
            self.client.wait(lambda: bool(points), "points", seconds)
        except AssertionError:
            return False
        finally:
            self.client.node.destroy_timer(timer)
        return True


@pytest.fixture(scope="module")
def started(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Manager]:
    """Start a managed lifter, once for all tests of this file."""
    folder = tmp_path_factory.mktemp("managed")
    with own_domain() as number, lifters(write_models(folder / "models"), folder) as start:
        process = start(listens=False, managed=True)
        client = Client(number)
        yield Manager(process, client)
        client.close()


@pytest.fixture
def manager(started: Manager) -> Iterator[Manager]:
    """Return the manager of a lifter that is unconfigured, before the test and after it."""
    assert started.state == "unconfigured"
    yield started
    assert started.process.process.poll() is None, started.process.log
    for label in ("deactivate", "cleanup"):
        started.change(label)
    assert started.state == "unconfigured"


def test_an_unconfigured_lifter_says_only_that(manager: Manager) -> None:
    assert not manager.answered()
    assert manager.topics() == {"/lifter/transition_event"}
    status = manager.client.wait_for_health(lambda s, v: v["state"] == "unconfigured")
    assert status.message == "unconfigured: waits for a transition (ros2 lifecycle set /lifter)"
    states = manager.ask("get_available_states", GetAvailableStates, GetAvailableStates.Request())
    labels = {state.label for state in states.available_states}
    assert {"unconfigured", "inactive", "active", "finalized"} <= labels
    kind = GetAvailableTransitions
    found = manager.ask("get_available_transitions", kind, kind.Request()).available_transitions
    assert {t.transition.label for t in found} == {"configure", "shutdown"}


def test_it_lifts_only_while_active_over_and_over(manager: Manager) -> None:
    events = manager.client.heard["/lifter/transition_event"]
    events.clear()
    for number in range(2):
        assert manager.change("configure") and manager.state == "inactive"
        assert not manager.answered()
        for _ in range(2):
            assert manager.change(number=Transition.TRANSITION_ACTIVATE)
            assert manager.answered(60) and manager.state == "active"
            assert manager.change("deactivate") and manager.state == "inactive"
            assert not manager.answered()
        assert "/lifter/points" in manager.topics()
        assert manager.change("cleanup") and manager.state == "unconfigured"
        manager.client.wait(
            lambda: manager.topics() == {"/lifter/transition_event"}, "no more topics"
        )
        reached = [
            e.goal_state.id for e in events if e.goal_state.id < State.PRIMARY_STATE_FINALIZED
        ]
        assert reached.count(State.PRIMARY_STATE_ACTIVE) == 2 * (number + 1)


def test_a_broken_model_is_a_failure_with_the_reason_and_a_good_one_heals_it(
    manager: Manager,
) -> None:
    assert not manager.client.set_parameters(model="broken")
    assert manager.client.set_parameters(min_visible=1)  # out of range: refused at once
    assert not manager.change("configure") and manager.state == "unconfigured"
    status = manager.client.wait_for_health(lambda s, v: s.level == ERROR)
    assert "cannot configure: " in status.message and "broken" in status.message
    assert status.message in manager.process.log
    assert not manager.client.set_parameters(model="person")
    assert manager.change("configure") and manager.change("activate") and manager.answered(60)


def test_a_transition_that_there_is_not_is_refused(manager: Manager) -> None:
    assert not manager.change(number=Transition.TRANSITION_ACTIVATE)
    assert not manager.change("activate") and not manager.change("dance")
    assert manager.state == "unconfigured" and "no transition" in manager.process.log


def test_an_inactive_lifter_does_not_train(manager: Manager) -> None:
    assert manager.change("configure")
    answer = manager.client.call("/lifter/train")
    assert not answer.success and "inactive" in answer.message


def test_the_model_is_released(domain: int, models: Path) -> None:
    words = ["managed:=true", "model:=person"]
    words += [f"models_dir:={models}", f"input_type:={POINT_CLOUD}"]
    rclpy.init(args=["--ros-args", *(w for text in words for w in ("-p", text))])
    try:
        node = lifter.LifterNode()
        lifecycle: Any = node._lifecycle
        entities = [*node.publishers, *node.services, *node.timers, *node.guards]
        endings: list[Callable[[], Any]] = [lifecycle.trigger_cleanup, lifecycle.trigger_shutdown]
        for end in endings:
            lifecycle.trigger_configure()
            model = weakref.ref(node._pipeline.model)
            lifecycle.trigger_activate()
            assert lifecycle.state == "active" and [*node.subscriptions]
            if end == lifecycle.trigger_cleanup:
                lifecycle.trigger_deactivate()
            end()
            gc.collect()
            assert model() is None
            assert entities == [*node.publishers, *node.services, *node.timers, *node.guards]
            assert not [*node.subscriptions]
        assert lifecycle.state == "finalized"
        node.destroy_node()
    finally:
        rclpy.try_shutdown()


def test_the_size_of_the_image_may_be_set_side_by_side_before_it_is_needed(
    domain: int, models: Path
) -> None:
    words = ["managed:=true", "model:=person", f"models_dir:={models}", "field_of_view:=90"]
    rclpy.init(args=["--ros-args", *(w for text in words for w in ("-p", text))])
    try:
        node = lifter.LifterNode()
        lifecycle: Any = node._lifecycle
        lifecycle.trigger_configure()
        assert lifecycle.state == "unconfigured" and "set image_width and" in lifecycle.problem
        for name, value in (("image_width", 640), ("image_height", 480)):
            assert node.set_parameters([Parameter(name, value=value)])[0].successful
        lifecycle.trigger_configure()
        assert lifecycle.state == "inactive" and node._camera.size == (640, 480)
        assert not node.set_parameters([Parameter("image_width", value=0)])[0].successful
        node.destroy_node()
    finally:
        rclpy.try_shutdown()


def test_without_lifecycle_msgs_the_start_says_what_is_missing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "deep_nrsfm_ros.node.lifecycle", None)
    node: Any = object.__new__(lifter.LifterNode)
    with pytest.raises(ValueError, match=r"managed is true, and .*lifecycle_msgs is missing"):
        node._manage()
