# SPDX-License-Identifier: Apache-2.0
"""The extras of the package: what an installation may lack, and how to add it."""

from __future__ import annotations

import importlib.util
from typing import NamedTuple


class Extra(NamedTuple):
    """An optional part of the installation.

    Attributes:
        module: the module whose absence shows that the extra is not installed.
        other_way: how else the module can be made available; "" if there is no other way.
    """

    module: str
    other_way: str


EXTRAS = {
    "train": Extra("torch", ""),
    "hdf5": Extra("h5py", ""),
    "ros": Extra("rclpy", " (or source your ROS installation)"),
}


class MissingExtraError(ImportError, ValueError):
    """A package of an extra is not installed; the text says which, and how to install it."""


def require_extra(extra: str, purpose: str) -> None:
    """Raise MissingExtraError unless an extra is installed.

    Args:
        extra: a name in `EXTRAS`, "train" or "ros".
        purpose: what needs it, for the error message: "training".
    """
    module = EXTRAS[extra].module
    if not is_installed(module):
        raise MissingExtraError(f"{purpose} needs {module}: {how_to_install(extra)}")


def how_to_install(extra: str) -> str:
    """Return the command that installs an extra, and the other way if there is one."""
    return f"pip install 'deep_nrsfm_ros[{extra}]'{EXTRAS[extra].other_way}"


def is_installed(module: str) -> bool:
    """Return True if a top-level module can be found; it is not imported."""
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):  # sys.modules has it without a spec
        return False
