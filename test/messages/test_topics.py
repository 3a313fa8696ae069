# SPDX-License-Identifier: Apache-2.0
"""Names of topics with a wildcard."""

from deep_nrsfm_ros.messages.topics import match


def test_what_a_wildcard_stands_for() -> None:
    pattern = "/humans/bodies/*/skeleton2d"
    assert match(pattern, "/humans/bodies/a1/skeleton2d") == "a1"
    assert match(pattern, "/humans/bodies/a/b/skeleton2d") is None
    assert match(pattern, "/humans/bodies/a1/skeleton2d/x") is None
    assert match("/*/k/*", "/a/k/b") == "a/b"
    assert match("/keypoints", "/keypoints") == ""
    assert match("/key.oints", "/keypoints") is None
