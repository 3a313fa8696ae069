# SPDX-License-Identifier: Apache-2.0
"""The package as others meet it: installed by pip, built by colcon, started by launch files."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml

import deep_nrsfm_ros
from deep_nrsfm_ros.configuration import options
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.messages.options import InputOptions

ROOT = Path(__file__).resolve().parents[1]
NAME = "deep_nrsfm_ros"
EXECUTABLES = sorted(path.name for path in (ROOT / "scripts").iterdir())
COMPILER = """#!/bin/sh
for word; do
    shift
    if [ "$word" = -O3 ]; then word=-O0; fi
    set -- "$@" "$word"
done
exec {} "$@"
"""
DOES_NOT_REACH_OTHER_PYTHONS = ("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "LD_LIBRARY_PATH", "PYTHONPATH")


def run(*command: str | Path, cwd: Path, **variables: object) -> str:
    """Return what `command` prints, run as from a fresh shell; fail with all of it if it fails."""
    kept = {k: v for k, v in os.environ.items() if k not in DOES_NOT_REACH_OTHER_PYTHONS}
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=kept | {key: str(value) for key, value in variables.items()},
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        timeout=120,
    )
    assert done.returncode == 0, f"{command} in {cwd} returned {done.returncode}:\n{done.stdout}"
    return done.stdout


def colcon(verb: str, *arguments: str, workspace: Path) -> str:
    command = Path(sysconfig.get_path("scripts")) / "colcon"
    words: list[str | Path] = ["--log-base", workspace / "log", verb, *arguments]
    return run(sys.executable, command, *words, cwd=workspace)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A colcon workspace with a copy of this package that has one test, which passes."""
    workspace = tmp_path_factory.mktemp("workspace")
    source = workspace / "src" / NAME
    left = shutil.ignore_patterns(
        ".*", "build", "install", "log", "runs", "demo_output", "*.egg-info", "__pycache__", "test"
    )
    shutil.copytree(ROOT, source, ignore=left)
    (source / "test").mkdir()
    (source / "test" / "test_probe.py").write_text("def test_probe():\n    pass\n")
    return workspace


@pytest.fixture(scope="module")
def installed_by_pip(workspace: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The prefix of a fresh environment after `pip install .`; no network is used.

    The build tool comes from this environment, and requirements stay out. The compiler does not
    optimise, which saves three quarters of its time.
    """
    prefix = tmp_path_factory.mktemp("pip") / "environment"
    compiler = prefix.with_name("compiler")
    compiler.write_text(COMPILER.format(os.environ.get("CC", "cc")))
    compiler.chmod(0o755)
    run(sys.executable, "-m", "venv", "--without-pip", prefix, cwd=workspace)
    run(
        *(sys.executable, "-m", "pip", "--python", prefix / "bin" / "python", "install", "."),
        *("--no-deps", "--no-build-isolation", "--no-index", "--ignore-installed"),
        cwd=workspace / "src" / NAME,
        PYTHONPATH=sysconfig.get_path("purelib"),
        CC=compiler,
    )
    return prefix


@pytest.fixture(scope="module")
def built_by_colcon(workspace: Path, installed_by_pip: Path) -> Path:
    """The prefix of the package after `colcon build`, which finds the kernel that pip compiled."""
    shutil.copytree(workspace / "src" / NAME / "build", workspace / "build" / NAME / "build")
    colcon("build", "--event-handlers", "console_direct+", workspace=workspace)
    return workspace / "install" / NAME


@pytest.fixture(params=["installed_by_pip", "built_by_colcon"])
def prefix(request: pytest.FixtureRequest) -> Path:
    path: Path = request.getfixturevalue(request.param)
    return path


def test_executables_are_where_ros2_run_looks(prefix: Path) -> None:
    folder = prefix / "lib" / NAME
    assert "lifter" in EXECUTABLES
    assert sorted(path.name for path in folder.iterdir()) == EXECUTABLES
    assert all(os.access(path, os.X_OK) for path in folder.iterdir())


@pytest.mark.parametrize(
    "name", [name for name in EXECUTABLES if name not in ("lifter", "mediapipe_detector")]
)
def test_executable_runs_from_an_installation(prefix: Path, name: str, tmp_path: Path) -> None:
    here = next(prefix.glob("lib/python*/site-packages"))
    there = sysconfig.get_path("purelib")  # what the package requires
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    shown = run(
        prefix / "lib" / NAME / name,
        "--help",
        cwd=tmp_path,
        PATH=path,
        PYTHONPATH=f"{here}{os.pathsep}{there}",
    )
    assert "usage:" in shown


def test_the_kernel_is_built_for_the_stable_abi(installed_by_pip: Path) -> None:
    (kernel,) = installed_by_pip.glob(f"lib/python*/site-packages/{NAME}/kernel/*.so")
    assert kernel.name == "_kernel.abi3.so"
    (wheel,) = installed_by_pip.glob(f"lib/python*/site-packages/{NAME}-*.dist-info/WHEEL")
    assert "Tag: cp311-abi3-" in wheel.read_text()


def test_one_command_is_on_the_path(prefix: Path, tmp_path: Path) -> None:
    here = next(prefix.glob("lib/python*/site-packages"))
    path = f"{here}{os.pathsep}{sysconfig.get_path('purelib')}"  # the package, and what it needs
    command = (sys.executable, prefix / "bin" / "deep-nrsfm")
    shown = run(*command, "models", "--help", cwd=tmp_path, PYTHONPATH=path)
    assert "usage: deep-nrsfm models" in shown
    shown = run(*command, "--version", cwd=tmp_path, PYTHONPATH=path)
    assert shown.split() == ["deep-nrsfm", deep_nrsfm_ros.__version__]


def test_ament_index_knows_the_package(prefix: Path) -> None:
    assert (prefix / "share/ament_index/resource_index/packages" / NAME).is_file()


def test_share_has_what_the_source_has(prefix: Path) -> None:
    share = prefix / "share" / NAME
    assert (share / "package.xml").read_bytes() == (ROOT / "package.xml").read_bytes()
    for folder, patterns in {
        "launch": ["*.launch.py"],
        "config": ["*.yaml", "*.rviz", "*.xml", "*.json"],
        "config/layouts": ["*.yaml"],
        "config/security": ["*.xml"],
        "config/mappings": ["*.yaml"],
        "models": ["*.safetensors", "*.md"],
    }.items():
        expected = sorted(p.name for pattern in patterns for p in (ROOT / folder).glob(pattern))
        assert expected, f"{folder}/ has nothing to install"
        installed = sorted(path.name for path in (share / folder).iterdir() if path.is_file())
        assert installed == expected


def test_colcon_sees_an_ament_python_package(workspace: Path) -> None:
    # colcon only warns of a package.xml that it cannot parse, and lists another type.
    assert colcon("list", workspace=workspace).split() == [
        NAME,
        f"src/{NAME}",
        "(ros.ament_python)",
    ]


def test_colcon_test_runs_pytest(workspace: Path, built_by_colcon: Path) -> None:
    # Without an extra that names pytest, colcon runs 0 tests and calls it a success.
    colcon("test", workspace=workspace)
    assert "Summary: 1 test, 0 errors, 0 failures, 0 skipped" in colcon(
        "test-result", "--all", workspace=workspace
    )


def test_versions_agree() -> None:
    declared = ElementTree.parse(ROOT / "package.xml").findtext("version")
    stated = run(sys.executable, "setup.py", "--version", cwd=ROOT).split()[-1]
    assert declared == stated == deep_nrsfm_ros.__version__


def test_config_sets_parameters_that_the_lifter_has() -> None:
    (namespace, content), *others = yaml.safe_load(
        (ROOT / "config" / "lifter.yaml").read_text()
    ).items()
    assert (namespace, others) == ("/**", [])  # whatever the node's name and namespace
    known = {
        field.name: (field, opt)
        for c in (InputOptions, LiftingOptions)
        for field, _, opt in options(c)
    }
    for name, value in content["ros__parameters"].items():
        field, option = known[name]
        assert type(value) is type(field.default)
        option.check(name, value)
