"""Message classes by name, imported when they are asked for: no detector's package is required."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def message_class(name: str) -> Any:
    """Return the class of messages of type "package/Type".

    Raises ValueError that says what to install when the package is absent.
    """
    package, _, kind = name.partition("/")
    try:
        found = getattr(import_module(f"{package}.msg"), kind, None)
    except ImportError as error:
        raise ValueError(
            f"messages of type {name} need the package {package}, which is not here ({error}): "
            f"install it (ros-jazzy-{package.replace('_', '-')}, or from source) and source the "
            "workspace that it is in"
        ) from None
    if found is None:
        raise ValueError(f"package {package} has no message {kind}")
    return found
