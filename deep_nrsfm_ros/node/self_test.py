# SPDX-License-Identifier: Apache-2.0
"""Self-test: send keypoints over DDS to a lifter in its own process and wait for points."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from array import array
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float32MultiArray

_GRACE = 10.0  # seconds in which the process must end


class SelfTestError(RuntimeError):
    """No points were received; the text says how far the test got.

    Attributes:
        ended: whether the lifter ended by itself.
    """

    def __init__(self, text: str, *, ended: bool) -> None:
        """Keep the text and whether the lifter ended by itself."""
        super().__init__(text)
        self.ended = ended


def time_to_first_points(model: str, keypoints: np.ndarray[Any, Any], seconds: float) -> float:
    """Start a lifter, send it keypoints, and return the seconds until its points arrive.

    The lifter runs in a namespace of its own, in the environment's domain and middleware.

    Args:
        model: name or path.
        keypoints: (p, 2) pixels, of one object.
        seconds: time limit; 30 typical.

    Raises:
        SelfTestError: no points within the time limit.
    """
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("doctor", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    namespace = f"/doctor_{node.get_clock().now().nanoseconds}"
    received: list[Any] = []
    message = Float32MultiArray(data=array("f", keypoints.astype(np.float32).ravel()))
    publisher = node.create_publisher(Float32MultiArray, f"{namespace}/keypoints", 1)
    node.create_subscription(PointCloud2, f"{namespace}/lifter/points", received.append, 1)
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "deep_nrsfm_ros.node.lifter", "--ros-args",
             "-r", f"__ns:={namespace}", "-p", f"model:={model}",
             "-p", "input_type:=std_msgs/Float32MultiArray"],
            stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        try:
            start, connected = time.monotonic(), False
            while not received and process.poll() is None and time.monotonic() - start < seconds:
                connected = connected or publisher.get_subscription_count() > 0
                publisher.publish(message)
                executor.spin_once(timeout_sec=0.1)
            duration = time.monotonic() - start
            code = process.poll()
        finally:
            _end(process)
            executor.shutdown()
            node.destroy_node()
            rclpy.shutdown(context=context)
        if received:
            return duration
        log.seek(0)
        output = log.read().decode(errors="replace").strip()[-500:] or "nothing"
    if code is not None:
        outcome = f"ended with exit code {code} after {duration:.0f} s"
    elif connected:
        outcome = f"was found and did not answer within {duration:.0f} s"
    else:
        outcome = f"was not found within {duration:.0f} s"
    raise SelfTestError(f"the lifter {outcome}; its output: {output}", ended=code is not None)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Terminate the lifter; kill it if it does not end."""
    process.terminate()
    try:
        process.wait(_GRACE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
