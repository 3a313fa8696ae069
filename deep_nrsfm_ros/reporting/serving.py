# SPDX-License-Identifier: Apache-2.0
"""A live page on localhost: frames arrive as server-sent events, without a further library."""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

HOST = "127.0.0.1"
_HOSTS = ("127.0.0.1", "localhost")  # other Host headers are refused, against DNS rebinding
_HEARTBEAT = 5.0  # seconds without a frame after which a connection is tested
_MAX_FRAMES = 3000  # kept for browsers that connect later


class Broadcast:
    """Frames for all connected browsers: the last ones at once, each further one as it arrives."""

    def __init__(self, most: int = _MAX_FRAMES) -> None:
        """Keep at most the last `most` frames for browsers that connect later."""
        self._frames: deque[str] = deque(maxlen=most)
        self._count, self._ended = 0, False
        self._changed = threading.Condition()

    def put(self, frame: Mapping[str, Any]) -> None:
        """Add a frame, a mapping that JSON can encode."""
        text = json.dumps(frame, allow_nan=False, separators=(",", ":"))
        with self._changed:
            self._frames.append(text)
            self._count += 1
            self._changed.notify_all()

    def end(self) -> None:
        """End the events of all browsers."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def events(self, after: int = 0) -> Iterator[str]:
        """Yield server-sent events for the frames after number `after`, until `end`.

        Without frames it yields a comment every 5 s, so that the server notices closed connections.
        """
        while True:
            with self._changed:
                if self._count <= after and not self._ended:
                    self._changed.wait(_HEARTBEAT)
                first = self._count - len(self._frames)
                waiting = list(self._frames)[max(0, after - first) :]
                ended, after = self._ended, self._count
            for number, text in enumerate(waiting, after - len(waiting) + 1):
                yield f"id: {number}\ndata: {text}\n\n"
            if ended:
                yield "event: end\ndata:\n\n"
                return
            if not waiting:
                yield ": nothing new\n\n"


def server(page: str, broadcast: Broadcast, port: int) -> ThreadingHTTPServer:
    """Return an HTTP server of a page and its frames; call `serve_forever` to start it.

    Args:
        page: HTML.
        broadcast: the frames.
        port: TCP port; 0 = any free one.

    Raises:
        OSError: the port is in use, or not allowed.
    """

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            host = (self.headers.get("Host") or "").rpartition(":")[0]
            if host not in _HOSTS:
                self.send_error(HTTPStatus.FORBIDDEN, "this server is for localhost alone")
            elif self.path == "/":
                self._respond("text/html; charset=utf-8", [page])
            elif self.path == "/frames":
                last = self.headers.get("Last-Event-ID", "")
                after = int(last) if last.isdigit() else 0
                self._respond("text/event-stream", broadcast.events(after))
            else:
                self.send_error(HTTPStatus.NOT_FOUND)

        def _respond(self, kind: str, parts: Iterable[str]) -> None:
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", kind)
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            try:
                for part in parts:
                    self.wfile.write(part.encode())
            except OSError:
                pass  # the browser has gone

        def log_message(self, *words: Any) -> None:
            pass

    try:
        http = ThreadingHTTPServer((HOST, port), Handler)
    except OSError as error:
        raise OSError(f"port {port} cannot be used ({error.strerror}): choose another") from error
    http.daemon_threads = True
    return http


def in_real_time(
    frames: Iterable[Mapping[str, Any]],
    put: Callable[[Mapping[str, Any]], None],
    wait: Callable[[float], Any] = time.sleep,
) -> None:
    """Put frames at their times `t` in s, relative to the first.

    Args:
        frames: mappings with `t`.
        put: called with each frame.
        wait: called with the seconds to wait.
    """
    start, first = time.monotonic(), None
    for frame in frames:
        first = frame["t"] if first is None else first
        left = frame["t"] - first - (time.monotonic() - start)
        if left > 0:
            wait(left)
        put(frame)
