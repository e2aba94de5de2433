# SPDX-License-Identifier: MIT
"""A TCP proxy in front of a server: connections through it fall silent, or are held back for a while.

No signal stops the server for that: if Triton 2.51's processes stop while one of them has a lock that
another waits for, Triton ends as soon as they go on ("boost::interprocess::lock_exception"). It was seen in 1 of 48
stops.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress


class Proxy:
    """Forwards TCP connections to a port, until it goes silent: connections stay open, and nothing comes over them.

    It stands in for a network that drops packets, which needs a privilege. ``reads``: what a client sends
    over a silent connection is still acknowledged, and dropped; otherwise nothing more is taken from it.
    """

    def __init__(self, port: int, *, reads: bool = True, host: str = "127.0.0.1") -> None:
        self._port = port
        self._reads = reads
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._listener = socket.create_server((host, 0), backlog=512, family=family)
        self.port = self._listener.getsockname()[1]
        self._is_closed = threading.Event()
        self._flows = threading.Event()
        self._flows.set()
        self._pairs: list[tuple[socket.socket, socket.socket, threading.Event]] = []
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def num_connections(self) -> int:
        return len(self._pairs)

    def go_silent(self) -> None:
        """Silence all present connections, but not new ones."""
        for *_, is_silent in self._pairs:
            is_silent.set()

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold all connections, old and new; the held bytes come afterwards."""
        self._flows.clear()
        try:
            yield
        finally:
            self._flows.set()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:  # closed: the test is over
                return
            if not self._reads and not self._pairs:
                near.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            if not self._greet(near) or self._is_closed.is_set():
                near.close()
                continue
            far = socket.create_connection(("127.0.0.1", self._port))
            is_silent = threading.Event()
            self._pairs.append((near, far, is_silent))
            for source, target in ((near, far), (far, near)):
                threading.Thread(target=self._forward, args=(source, target, is_silent), daemon=True).start()

    def _greet(self, near: socket.socket) -> bool:
        """Read the bytes before those for the server. Return True if the connection goes on to the server."""
        return True

    def _forward(self, source: socket.socket, target: socket.socket, is_silent: threading.Event) -> None:
        while True:
            if is_silent.is_set() and not self._reads:
                self._is_closed.wait()
            try:
                content = source.recv(65536)
                self._flows.wait()
                if not is_silent.is_set():
                    target.sendall(content)
            except OSError:  # one side has ended it
                return
            if not content:
                with suppress(OSError):
                    target.shutdown(socket.SHUT_WR)
                return

    def __enter__(self) -> Proxy:
        return self

    def __exit__(self, *_: object) -> None:
        self._is_closed.set()
        self._listener.close()
        for near, far, _ in self._pairs:
            for end in (near, far):
                with suppress(OSError):  # the other side has ended it
                    end.shutdown(socket.SHUT_RDWR)  # also under a thread that waits for it
                end.close()


class HttpProxy(Proxy):
    """An HTTP proxy for CONNECT that maps every host to the port. asked: the ``host:port`` of each CONNECT."""

    def __init__(self, port: int) -> None:
        self.asked: list[str] = []
        super().__init__(port)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def _greet(self, near: socket.socket) -> bool:
        head = b""
        while not head.endswith(b"\r\n\r\n"):
            if not (byte := near.recv(1)):
                return False
            head += byte
        self.asked.append(head.split()[1].decode())
        near.sendall(b"HTTP/1.1 200 OK\r\n\r\n")
        return True
