"""The other side of a wire, which says what the input says, and a watch on the threads of whoever reads it."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable, Generator
from typing import Self

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


class Listener:
    """A server for one client after another, which serves for the time of a `with` block."""

    def __init__(self, host: str = "127.0.0.1", port: int = 0) -> None:
        self._listener = socket.create_server((host, port))
        self.port = int(self._listener.getsockname()[1])
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> Self:
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
                    self.converse(link)

    def converse(self, link: socket.socket) -> None:
        """Talk to a client until it, or this, has nothing more to say."""
        raise NotImplementedError


class Peer(Listener):
    """A listener on a free port of this machine, which says what it is told to say.

    Args:
        greets: said to each client at once.
        answers: what is said after each piece that a client sends.
        goes_on: said again and again while the client is silent.
    """

    def __init__(self, greets: bytes, answers: Callable[[bytes], bytes], goes_on: bytes = b"") -> None:
        super().__init__()
        self._greets, self._answers, self._goes_on = greets, answers, goes_on

    def converse(self, link: socket.socket) -> None:
        """Greet, then answer."""
        link.settimeout(_PERIOD_S if self._goes_on else 5.0)
        link.sendall(self._greets)
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
