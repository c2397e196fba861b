"""The other side of a wire, which says what the input says, and a watch on the threads of whoever reads it."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable, Generator

_PERIOD_S = 0.01


@contextlib.contextmanager
def threads_watched() -> Generator[list[BaseException]]:
    """Collect the exceptions that end threads within the block."""
    died: list[BaseException] = []
    before = threading.excepthook

    def keep(arguments: threading.ExceptHookArgs) -> None:
        if arguments.exc_value is not None:
            died.append(arguments.exc_value)

    threading.excepthook = keep
    try:
        yield died
    finally:
        threading.excepthook = before
    if died:
        raise died[0]


class Peer:
    """A server on a free port of this machine for one client after another.

    Args:
        greets: said to each client at once.
        answers: what is said after each piece that a client sends.
        goes_on: said again and again while the client is silent.
    """

    def __init__(self, greets: bytes, answers: Callable[[bytes], bytes], goes_on: bytes = b"") -> None:
        self._greets, self._answers, self._goes_on = greets, answers, goes_on
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> Peer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join(5.0)

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                link, _ = self._listener.accept()
                with link, contextlib.suppress(OSError):
                    link.settimeout(_PERIOD_S if self._goes_on else 5.0)
                    link.sendall(self._greets)
                    self._converse(link)

    def _converse(self, link: socket.socket) -> None:
        while True:
            try:
                heard = link.recv(4096)
            except TimeoutError:
                if not self._goes_on:
                    return
                link.sendall(self._goes_on)
                continue
            if not heard:
                return
            link.sendall(self._answers(heard))
