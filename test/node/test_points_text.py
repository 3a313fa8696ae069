# SPDX-License-Identifier: Apache-2.0
"""`deep-nrsfm echo` prints what a lifter publishes as numbers, over DDS."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import PointCloud2

from deep_nrsfm_ros.commands import echo
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.messages.decoding import read_points
from test.fixtures.forked_python import NODE, ROOT, ForkedPython
from test.node.conftest import DEADLINE
from test.node.test_lifter_client import message


def test_points_are_printed_by_name_and_identity(
    start_lifter: Callable[..., Any], connect: Callable[[], Any], domain: int
) -> None:
    start_lifter()
    client = connect()
    publisher = client.publisher(PointCloud2)

    def run(*words: str) -> tuple[int, str, str]:
        """Return exit code and output of `echo`, while messages come, a new one each time."""
        program = ["-m", "deep_nrsfm_ros.commands.echo", *words]
        given: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        given["env"] = os.environ | {"PYTHONPATH": str(ROOT), "ROS_DOMAIN_ID": str(domain)}
        with ForkedPython(program, NODE, **given) as process:
            second = iter(range(1, 10_000))

            def ended() -> bool:
                answer = message(next(second))
                answer.header.frame_id = "base_link"
                publisher.publish(answer)
                return process.poll() is not None

            client.wait(ended, "echo to end", DEADLINE)
            out, err = process.communicate(timeout=DEADLINE)
        return process.returncode, out, err

    code, out, err = run("--once", "--rate", "0")
    assert code == 0 and "waiting for /lifter/points" in err
    title, *lines = out.splitlines()
    (stamp,) = re.findall(r"^(\d+)\.000 s: x, y, z in base_link, confidence$", title)
    (points,) = [
        read_points(m) for m in client.heard["/lifter/points"] if m.header.stamp.sec == int(stamp)
    ][-1:]
    rows = [line.split() for line in lines]
    assert [row[1] for row in rows] == [*HUMAN17.keypoints] * 2
    # A second between stamps may begin new identities, and points may come without theirs.
    shown = {row[0] for row in rows}
    assert len(shown) == 2 and all(re.fullmatch(r"[01]|object\d+", name) for name in shown)
    printed = np.array([row[2:] for row in rows], float)
    np.testing.assert_allclose(printed, points.reshape(-1, 4), atol=0.0051)

    code, out, _ = run("--once", "--keypoint", "left_wrist")
    assert code == 0 and [line.split()[1] for line in out.splitlines()[1:]] == ["left_wrist"] * 2

    code, out, err = run("--keypoint", "left_wirst")
    assert (code, out) == (2, "")
    assert "the model of /lifter has no keypoint 'left_wirst'; did you mean 'left_wrist'" in err


def test_a_rate_that_is_none_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for rate in ("-1", "nan"):
        with pytest.raises(SystemExit) as end:
            echo.main(["--rate", rate])
        assert end.value.code == 2
        assert f"--rate is {rate}; it must be at least 0" in capsys.readouterr().err
