"""Message classes by name, imported when they are asked for: no detector's package is required."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

from rclpy.serialization import deserialize_message

from deep_nrsfm_ros.lifting.observation import MessageError


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


def decoder(name: str) -> Callable[[bytes], Any]:
    """Return what makes messages of type "package/Type" of bytes, or raises MessageError.

    Raises ValueError as `message_class` does.
    """
    found = message_class(name)

    def decode(raw: bytes) -> Any:
        try:
            return deserialize_message(raw, found)
        except Exception as error:  # of the middleware, of several kinds
            raise MessageError(f"{len(raw)} bytes that are no {name}: {error}") from None

    return decode
