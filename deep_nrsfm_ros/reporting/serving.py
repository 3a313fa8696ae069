"""A page on localhost whose frames come as they happen: server-sent events, no library needed."""

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
_NAMES = ("127.0.0.1", "localhost")  # by which browsers may ask, so that no other site can
_HEARTBEAT = 5.0  # seconds after which a silent connection is tried
_MOST = 3000  # frames that are kept for browsers that come later


class Broadcast:
    """Frames for every browser that looks: those that came before, then each as it comes."""

    def __init__(self, most: int = _MOST) -> None:
        """Keep the last `most` frames."""
        self._frames: deque[str] = deque(maxlen=most)
        self._count, self._ended = 0, False
        self._changed = threading.Condition()

    def put(self, frame: Mapping[str, Any]) -> None:
        """Add a frame."""
        text = json.dumps(frame, allow_nan=False, separators=(",", ":"))
        with self._changed:
            self._frames.append(text)
            self._count += 1
            self._changed.notify_all()

    def end(self) -> None:
        """Say that no frame will come any more."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def events(self, after: int = 0) -> Iterator[str]:
        """Yield server-sent events for the frames after the number `after`, as long as they come.

        A comment in times of silence lets the server find out who is gone.
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
    """Return a server of the page and its frames; `serve_forever` starts it, `shutdown` ends it.

    port: 0 takes a free one. Raises OSError if the port is taken.
    """

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            host = (self.headers.get("Host") or "").rpartition(":")[0]
            if host not in _NAMES:
                self.send_error(HTTPStatus.FORBIDDEN, "this server is for localhost alone")
            elif self.path == "/":
                self._answer("text/html; charset=utf-8", [page])
            elif self.path == "/frames":
                last = self.headers.get("Last-Event-ID", "")
                after = int(last) if last.isdigit() else 0
                self._answer("text/event-stream", broadcast.events(after))
            else:
                self.send_error(HTTPStatus.NOT_FOUND)

        def _answer(self, kind: str, parts: Iterable[str]) -> None:
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

    made = ThreadingHTTPServer((HOST, port), Handler)
    made.daemon_threads = True
    return made


def in_real_time(
    frames: Iterable[Mapping[str, Any]],
    put: Callable[[Mapping[str, Any]], None],
    wait: Callable[[float], Any] = time.sleep,
) -> None:
    """Put frames at the pace of their times `t` in s, the first at once."""
    began, first = time.monotonic(), None
    for frame in frames:
        first = frame["t"] if first is None else first
        left = frame["t"] - first - (time.monotonic() - began)
        if left > 0:
            wait(left)
        put(frame)
