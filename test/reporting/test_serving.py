# SPDX-License-Identifier: Apache-2.0
"""The page on localhost shows frames as they come, and those that came before."""

from __future__ import annotations

import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import pytest

from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.reporting.player import live_page
from deep_nrsfm_ros.reporting.serving import HOST, Broadcast, in_real_time, server


def frame(t: float) -> dict[str, Any]:
    """Return a frame with one person of whom all keypoints are on one line."""
    seen = [v for i in range(17) for v in (100 + i, 100 + 10 * i + t, 0.9)]
    shape = [v for i in range(17) for v in (0.1 * i - 0.8, 0.1 * i - 0.8 + t / 100, 0.0)]
    lifted = {
        "shape": shape,
        "confidence": [0.9] * 17,
        "position": [0, 0, 0],
        "size": 1,
        "residual": None,
    }
    one = {"identity": "0", "keypoints": seen, "rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], **lifted}
    return {"t": t, "camera": None, "objects": [one]}


@pytest.fixture
def broadcast() -> Broadcast:
    return Broadcast(most=3)


@pytest.fixture
def address(broadcast: Broadcast) -> Iterator[str]:
    """Return where the page is served."""
    with server(live_page(HUMAN17, HUMAN17, "live"), broadcast, 0) as made:
        threading.Thread(target=made.serve_forever, daemon=True).start()
        yield f"http://{HOST}:{made.server_port}/"
        broadcast.end()
        made.shutdown()


def numbers(events: Iterator[str]) -> list[str]:
    return [event.splitlines()[0] for event in events]


def test_whoever_comes_later_gets_what_is_kept(broadcast: Broadcast) -> None:
    for t in range(5):
        broadcast.put({"t": t})
    broadcast.end()
    assert numbers(broadcast.events()) == ["id: 3", "id: 4", "id: 5", "event: end"]
    assert numbers(broadcast.events(after=4)) == ["id: 5", "event: end"]
    assert numbers(broadcast.events(after=99)) == ["event: end"]


def test_frames_come_as_they_are_put(broadcast: Broadcast) -> None:
    events = broadcast.events()
    for t in range(6):
        broadcast.put({"t": t})
        assert next(events) == f'id: {t + 1}\ndata: {{"t":{t}}}\n\n'


def test_only_this_machine_may_ask(address: str) -> None:
    with urllib.request.urlopen(address) as answer:
        assert b"EventSource" in answer.read()
    for path, host, code in (("", "evil.example:80", 403), ("secret", "localhost:80", 404)):
        request = urllib.request.Request(address + path, headers={"Host": host})
        with pytest.raises(urllib.error.HTTPError) as refusal:
            urllib.request.urlopen(request)
        assert refusal.value.code == code


def test_frames_keep_their_pace() -> None:
    put: list[float] = []
    waits: list[float] = []
    in_real_time(
        [{"t": 1e9 + 100 * i} for i in range(4)], lambda f: put.append(f["t"]), waits.append
    )
    assert put == [1e9, 1e9 + 100, 1e9 + 200, 1e9 + 300]
    assert [round(wait, -1) for wait in waits] == [100, 200, 300]  # the clock stands still here


def test_a_browser_follows_until_it_is_held_back(
    tab: Any, broadcast: Broadcast, address: str
) -> None:
    broadcast.put(frame(0))
    tab.open(address)
    tab.wait("frames.length === 1 && index === 0")
    before = tab.evaluate("document.getElementById('lifted').toDataURL()")
    broadcast.put(frame(50))
    tab.wait("index === 1")
    assert tab.evaluate("document.getElementById('lifted').toDataURL()") != before
    tab.press("Home")
    broadcast.put(frame(60))
    tab.wait("frames.length === 3")
    assert tab.evaluate("[index, document.getElementById('state').textContent]") == [
        0,
        "live, paused",
    ]
    tab.press("End")
    broadcast.put(frame(70))
    tab.wait("index === 3")
    broadcast.end()
    tab.wait("document.getElementById('state').textContent === 'end of the recording'")


def test_a_port_in_use_is_named() -> None:
    with server("", Broadcast(), 0) as first, pytest.raises(OSError, match="cannot be used"):
        server("", Broadcast(), first.server_port)
