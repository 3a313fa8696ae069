# SPDX-License-Identifier: Apache-2.0
"""The SROS2 policy allows what the lifter does, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from test.node.conftest import Connect, StartLifter

POLICY = Path(__file__).resolve().parents[2] / "config" / "security" / "lifter.policy.xml"
KINDS = ("publish", "subscribe", "reply", "request")


def allowed(enclave: str) -> dict[str, set[str]]:
    """Return the full names of topics and services that an enclave may use, by KINDS."""
    found: dict[str, set[str]] = {kind: set() for kind in KINDS}
    (profile,) = ElementTree.parse(POLICY).findall(f".//enclave[@path='{enclave}']//profile")
    ns, node = profile.attrib["ns"], profile.attrib["node"]
    for rules in profile:
        for kind, rule in rules.attrib.items():
            assert rule == "ALLOW"
            for word in (str(element.text) for element in rules):
                own = word.replace("~", f"{ns}{node}", 1)
                found[kind].add(own if own.startswith("/") else ns + own)
    return found


def test_the_lifter_may_do_what_it_does_and_no_more(
    start_lifter: StartLifter, connect: Connect
) -> None:
    tf = {"tf_prefix": "person_"} if find_spec("tf2_msgs") else {}  # it is not on PyPI
    start_lifter(use_sim_time=True, camera_info="camera_info", **tf)
    client = connect()
    node = client.node
    client.wait(lambda: "lifter" in node.get_node_names(), "the lifter")
    asked = {
        "publish": node.get_publisher_names_and_types_by_node,
        "subscribe": node.get_subscriber_names_and_types_by_node,
        "reply": node.get_service_names_and_types_by_node,
        "request": node.get_client_names_and_types_by_node,
    }
    lifter = allowed("/lifter")
    lifter["publish"] -= set() if tf else {"/tf"}
    for kind, ask in asked.items():

        def same(kind: str = kind, ask: Callable[..., list[Any]] = ask) -> bool:
            return {name for name, _ in ask("lifter", "/")} == lifter[kind]

        try:
            client.wait(same, f"what the lifter may {kind}")
        except AssertionError:  # the state after the wait tells more than the one before it
            assert {name for name, _ in ask("lifter", "/")} == lifter[kind], kind


def test_others_may_ask_only_for_what_the_lifter_offers() -> None:
    lifter, user, operator = map(allowed, ("/lifter", "/lifter_user", "/lifter_operator"))
    everybody = {"/parameter_events", "/rosout"}
    for other in (user, operator):
        assert other["subscribe"] <= lifter["publish"] and other["request"] <= lifter["reply"]
        assert other["publish"] == everybody and not other["reply"]
    assert not user["request"]
    assert {"/lifter/train", "/lifter/set_parameters"} <= operator["request"]
