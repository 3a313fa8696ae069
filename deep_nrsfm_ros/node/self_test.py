"""A lifter in a process of its own, asked over DDS for one answer."""

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

_GRACE = 10.0


class SelfTestError(RuntimeError):
    """No answer came: says how far it got."""


def time_to_first_points(model: str, keypoints: np.ndarray[Any, Any], seconds: float) -> float:
    """Start a lifter in a namespace of its own, send keypoints (p, 2), return after how many s.

    Uses the domain and the middleware of the environment. Raises SelfTestError when nothing came
    within `seconds`.
    """
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("doctor", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    namespace = f"/doctor_{node.get_clock().now().nanoseconds}"
    heard: list[Any] = []
    message = Float32MultiArray(data=array("f", keypoints.astype(np.float32).ravel()))
    publisher = node.create_publisher(Float32MultiArray, f"{namespace}/keypoints", 1)
    node.create_subscription(PointCloud2, f"{namespace}/lifter/points", heard.append, 1)
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "deep_nrsfm_ros.node.lifter", "--ros-args",
             "-r", f"__ns:={namespace}", "-p", f"model:={model}",
             "-p", "input_type:=std_msgs/Float32MultiArray"],
            stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        try:
            begin, met = time.monotonic(), False
            while not heard and process.poll() is None and time.monotonic() - begin < seconds:
                met = met or publisher.get_subscription_count() > 0
                publisher.publish(message)
                executor.spin_once(timeout_sec=0.1)
            took = time.monotonic() - begin
        finally:
            _end(process)
            executor.shutdown()
            node.destroy_node()
            rclpy.shutdown(context=context)
        if heard:
            return took
        log.seek(0)
        words = log.read().decode(errors="replace").strip()[-500:] or "nothing"
    found = "did not answer" if met else "was not found"
    raise SelfTestError(f"the lifter {found} within {took:.0f} s; it said: {words}")


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the lifter, by force if need be."""
    process.terminate()
    try:
        process.wait(_GRACE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
