# SPDX-License-Identifier: Apache-2.0
"""Launch files name only what exists: stand-ins for `launch`, not on PyPI, record what they say."""

from __future__ import annotations

import os
import re
import runpy
import sys
import types
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
NAME = "deep_nrsfm_ros"
FILES = sorted((ROOT / "launch").glob("*.launch.py"))
OF_ROS = {"rviz2": {"rviz2"}, "tf2_ros": {"static_transform_publisher"}}
MODULES = {
    "launch": ["LaunchDescription"],
    "launch.actions": ["DeclareLaunchArgument", "ExecuteProcess", "IncludeLaunchDescription"],
    "launch.conditions": ["IfCondition"],
    "launch.launch_description_sources": ["PythonLaunchDescriptionSource"],
    "launch.substitutions": [
        "LaunchConfiguration",
        "NotEqualsSubstitution",
        "PathJoinSubstitution",
    ],
    "launch_ros": [],
    "launch_ros.actions": ["Node"],
    "launch_ros.parameter_descriptions": ["ParameterValue"],
    "launch_ros.substitutions": ["FindPackageShare"],
}
PUBLISHED = {"/lifter/points", "/lifter/markers", "/lifter/camera_rotation"}


class Entity:
    """Whatever a launch file makes: its kind and what it was given."""

    def __init__(self, kind: str, *given: Any, **named: Any) -> None:
        self.kind, self.given, self.named = kind, given, named

    def walk(self) -> Iterator[Entity]:
        """Yield this entity and all within it."""
        yield self
        waiting = [*self.given, *self.named.values()]
        while waiting:
            item = waiting.pop()
            if isinstance(item, Entity):
                yield from item.walk()
            elif isinstance(item, dict):
                waiting += item.values()
            elif isinstance(item, (list, tuple)) or type(item).__name__ == "dict_items":
                waiting += item


@pytest.fixture
def description(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Entity:
    """Return what a launch file describes, made of entities."""
    for name, classes in MODULES.items():
        module = types.ModuleType(name)
        for kind in classes:
            setattr(module, kind, lambda *given, k=kind, **named: Entity(k, *given, **named))
        monkeypatch.setitem(sys.modules, name, module)
    described: Entity = runpy.run_path(str(request.param))["generate_launch_description"]()
    return described


def of_kind(description: Entity, kind: str) -> list[Entity]:
    return [entity for entity in description.walk() if entity.kind == kind]


def arguments_of(path: Path) -> set[str]:
    return set(re.findall(r'DeclareLaunchArgument\(\s*"(\w+)"', path.read_text()))


each_file = pytest.mark.parametrize(
    "description", FILES, indirect=True, ids=[file.name for file in FILES]
)


@each_file
def test_every_argument_is_described_and_declared(description: Entity) -> None:
    declared = {entity.given[0] for entity in of_kind(description, "DeclareLaunchArgument")}
    for entity in of_kind(description, "DeclareLaunchArgument"):
        assert entity.named["description"].endswith(".")
    used = {entity.given[0] for entity in of_kind(description, "LaunchConfiguration")}
    assert used == declared and used


@each_file
def test_every_node_and_file_exists(description: Entity) -> None:
    ours = {path.name for path in (ROOT / "scripts").iterdir()}
    depends = {
        node.text for node in ElementTree.parse(ROOT / "package.xml").iterfind("exec_depend")
    }
    for node in of_kind(description, "Node"):
        package, executable = node.named["package"], node.named["executable"]
        assert executable in (ours if package == NAME else OF_ROS[package])
        assert package in {NAME, "rviz2"} or package in depends  # RViz: for those who look
    for path in of_kind(description, "PathJoinSubstitution"):
        share, *parts = path.given[0]
        assert (share.kind, share.given) == ("FindPackageShare", (NAME,))
        assert ROOT.joinpath(*parts).is_file()


@each_file
def test_included_files_have_the_arguments_they_are_given(description: Entity) -> None:
    for included in of_kind(description, "IncludeLaunchDescription"):
        (source,) = included.given
        path = ROOT.joinpath(*source.given[0].given[0][1:])
        given = {name for name, _ in included.named["launch_arguments"]}
        assert given and given <= arguments_of(path)


@each_file
def test_the_lifter_comes_last_and_ends_with_its_launch(description: Entity) -> None:
    *before, last = [e for e in description.given[0] if e.kind != "DeclareLaunchArgument"]
    assert last.kind in ("Node", "IncludeLaunchDescription")
    assert all(e.kind != "IncludeLaunchDescription" for e in before)
    for node in of_kind(description, "Node"):
        if node.named["package"] == NAME:
            assert node.named["additional_env"] == {"DEEP_NRSFM_LAUNCH_PID": str(os.getpid())}


@each_file
def test_commands_play_a_bag_or_are_those_of_the_user(description: Entity) -> None:
    for process in of_kind(description, "ExecuteProcess"):
        first, *rest = process.named["cmd"]
        if first == "ros2":
            assert rest[:2] == ["bag", "play"]
        else:  # a command that the user gives
            assert (first.kind, process.named["shell"]) == ("LaunchConfiguration", True)


def test_rviz_shows_what_the_lifter_publishes() -> None:
    content = yaml.safe_load((ROOT / "config" / "lifter.rviz").read_text())
    displays = content["Visualization Manager"]["Displays"]
    topics = {display["Topic"]["Value"] for display in displays if "Topic" in display}
    assert topics == {"/lifter/points", "/lifter/markers"} <= PUBLISHED
    source = (ROOT / NAME / "node" / "lifter.py").read_text()
    for topic in PUBLISHED:
        assert f'"~/{topic.rpartition("/")[2]}"' in source
    (cloud,) = [d for d in displays if d["Class"].endswith("PointCloud2")]
    assert cloud["Channel Name"] == "confidence"
