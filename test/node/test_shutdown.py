# SPDX-License-Identifier: Apache-2.0
"""A context that a signal shuts down at the same time is no error."""

from __future__ import annotations

import pytest
import rclpy

from deep_nrsfm_ros.node.shutdown import shut_down


def test_a_signal_between_the_test_and_the_shutdown_is_no_error(
    monkeypatch: pytest.MonkeyPatch, domain: int
) -> None:
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    shut_down(context)
    assert not context.ok()
    monkeypatch.setattr(rclpy.Context, "ok", lambda self: True)  # as it was a moment ago
    with pytest.raises(RuntimeError, match="already"):
        rclpy.try_shutdown(context=context)
    shut_down(context)
