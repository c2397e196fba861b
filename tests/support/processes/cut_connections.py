"""Stands between the program and PostgreSQL, and cuts a connection at the moment of a commit."""

from __future__ import annotations

import shutil
import socket
import tempfile
import threading
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

_SOCKET = ".s.PGSQL.5432"
_COMMIT = b"COMMIT\x00"  # as it ends a simple query
_BYTES = 65536
Cut = Literal["before it arrives", "after it was done"]


class CutConnections:
    """A socket like the server's that passes everything on, but for the next COMMIT once `cut` is set."""

    def __init__(self, server: Path) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="oc-cut-", dir="/tmp"))
        self.cut: Cut | None = None  # the next commit is cut so; None again afterwards
        self.away = False  # new connections are refused
        self.seen = 0  # commits that were cut
        self._server = server / _SOCKET
        self._listening = socket.socket(socket.AF_UNIX)
        self._listening.bind(str(self.folder / _SOCKET))
        self._listening.listen()
        self._accepting = threading.Thread(target=self._accept, daemon=True)
        self._accepting.start()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listening.accept()
            except OSError:  # the end
                return
            if self.away:
                client.close()
                continue
            server = socket.socket(socket.AF_UNIX)
            server.connect(str(self._server))
            threading.Thread(target=self._to_server, args=(client, server), daemon=True).start()
            threading.Thread(target=_pass_on, args=(server, client), daemon=True).start()

    def _to_server(self, client: socket.socket, server: socket.socket) -> None:
        with suppress(OSError):
            while data := client.recv(_BYTES):
                cut = self.cut if _COMMIT in data else None
                if cut is None:
                    server.sendall(data)
                    continue
                self.cut = None
                self.seen += 1
                client.shutdown(socket.SHUT_RDWR)  # the answer reaches nobody
                if cut == "after it was done":
                    server.sendall(data)
                break
        with suppress(OSError):
            server.shutdown(socket.SHUT_WR)  # it ends once it has done what it was sent

    def close(self) -> None:
        """Pass nothing on any more."""
        with suppress(OSError):
            self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        self._accepting.join()
        shutil.rmtree(self.folder)


def _pass_on(server: socket.socket, client: socket.socket) -> None:
    with suppress(OSError):
        while data := server.recv(_BYTES):
            client.sendall(data)
    client.close()
    server.close()


@contextmanager
def cut_connections(server: Path) -> Generator[CutConnections]:
    """Listen in a folder of its own, in place of the server in another folder."""
    made = CutConnections(server)
    try:
        yield made
    finally:
        made.close()
