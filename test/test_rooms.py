# SPDX-License-Identifier: Apache-2.0
"""Rooms import one way, and ROS is imported where it belongs."""

from __future__ import annotations

import ast
import functools
import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "deep_nrsfm_ros"
NAME = PACKAGE.name
FLOORS = (
    {"configuration", "yaml_file", "batched", "extras", "similar_names", "wording"},
    {"large_arrays"},
    {"layouts"},
    {"nrsfm"},
    {"kernel"},
    {"body"},
    {"model_files"},
    {"lifting"},
    {"messages"},
    {"data"},
    {"training"},
    {"reporting"},
    {"node"},
    {"commands"},
)
"""The rooms from the ground up: a room imports itself and what is below it."""
FLOOR = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}
FRONT_DOOR = {"__init__", "__main__"}
ROS_PROGRAMS = {"commands/demo/client.py", "commands/echo.py", "commands/replay.py"}
"""The programs that import ROS themselves."""
NODE_CLIENTS = {
    "commands/doctor.py",
    "commands/echo.py",
    "commands/lifter.py",
    "commands/replay.py",
}
"""The programs that import the node's room."""
ROS = ("rclpy", "rosidl", "builtin_interfaces", "rcl_interfaces", "std_srvs", "tf2_ros")


def is_ros(module: str) -> bool:
    package = module.split(".")[0]
    return package.startswith(ROS) or package.endswith("_msgs")


@functools.cache
def imports(path: Path) -> tuple[str, ...]:
    """Return every module that a file imports, anywhere in it."""
    modules: list[str] = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            modules += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert not node.level, f"{path} imports relatively"
            modules += [f"{node.module}.{alias.name}" for alias in node.names]
    return tuple(modules)


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def files() -> Iterator[tuple[Path, str]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        yield path, path.relative_to(PACKAGE).as_posix()


def test_every_file_is_in_a_room() -> None:
    assert {room_of(path) for path, _ in files()} == set(FLOOR) | FRONT_DOOR


def test_rooms_import_only_what_is_below_them() -> None:
    offenders = []
    for path, name in files():
        room = room_of(path)
        if room in FRONT_DOOR:
            continue
        for module in imports(path):
            first, _, rest = module.partition(".")
            other = rest.split(".")[0]
            if first != NAME or other == room or other not in FLOOR:
                continue
            if FLOOR[other] >= FLOOR[room]:
                offenders.append(f"{name} imports {module}")
    assert not offenders


def test_every_file_of_the_node_imports_ros() -> None:
    for path in (PACKAGE / "node").glob("*.py"):
        assert path.stem == "__init__" or any(map(is_ros, imports(path))), path


def test_nothing_else_imports_ros_but_programs_that_talk_to_it() -> None:
    talking = {name for path, name in files() if any(map(is_ros, imports(path)))}
    assert {name for name in talking if not name.startswith("node/")} <= ROS_PROGRAMS


def test_only_programs_that_talk_to_ros_import_the_node() -> None:
    clients = {
        name
        for path, name in files()
        if room_of(path) != "node" and any(m.startswith(f"{NAME}.node") for m in imports(path))
    }
    assert clients <= NODE_CLIENTS


@pytest.mark.parametrize("program", ["lift", "train", "evaluate", "models"])
def test_a_program_for_files_loads_no_ros_and_no_torch(program: str) -> None:
    if importlib.util.find_spec(f"{NAME}.commands.{program}") is None:
        pytest.fail(f"no program {program}")
    code = (
        f"import sys, {NAME}.commands.{program}\n"
        f"print(*(m for m in sys.modules if m.split('.')[0] in ('rclpy', 'torch') "
        f"or m.startswith('{NAME}.node')))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.split() == []
