"""`orthocapture serve` as a process, with its address, its log and a signed-in user."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx

from tests.support.pages.accounts import PASSWORD, PIN
from tests.support.processes.forked import Forked
from tests.support.rig.rig import REPOSITORY, command


@dataclass
class Server:
    """A running server."""

    url: str
    set_up: str  # link for the first set-up; "" if there is an administrator
    process: subprocess.Popen[str]
    log: Path  # its stderr

    @property
    def address(self) -> tuple[str, int]:
        """The address at which it listens."""
        return "127.0.0.1", int(self.url.rpartition(":")[2])

    def signed_in(self) -> dict[str, str]:
        """Request headers of the first administrator, whose account is created by the first set-up."""
        secret = {"password": PASSWORD, "repeated": PASSWORD, "pin": PIN}
        made = httpx.post(self.set_up, data={"account": "ada", "full_name": "Ada Lovelace", **secret}, timeout=30)
        assert made.status_code == 303, made.text
        form = {"account": "ada", "password": PASSWORD}
        answer = httpx.post(f"{self.url}/sign-in", data=form, timeout=30)
        assert answer.status_code == 303, answer.text
        return {"Cookie": answer.headers["set-cookie"].partition(";")[0]}

    def refused_sign_in(self, account: str, headers: list[tuple[str, str]] | None = None) -> httpx.Response:
        """Try to sign in with a wrong password."""
        form = {"account": account, "password": "wrong"}
        return httpx.post(f"{self.url}/sign-in", data=form, headers=headers, timeout=30)


@contextmanager
def serving(rig: Path, *options: str, most_files: int = 0) -> Generator[Server]:
    """Serve the folder `data` beside the rig file; `most_files` limits the process's open files."""
    words = command("serve", "--rig", str(rig), "--data", str(rig.parent / "data"), "--port", "0", "--json", *options)
    if most_files:
        words = ["sh", "-c", f'ulimit -n {most_files}; exec "$0" "$@"', *words]
    log = rig.parent / "serve.log"
    with (
        log.open("a") as stderr,
        Forked(words, cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=stderr, text=True) as process,
    ):
        assert process.stdout is not None
        try:
            line = process.stdout.readline()
            assert line, f"it did not start: {log.read_text()}"
            ready = json.loads(line)
            yield Server(ready["url"], ready["set_up"], process, log)
        finally:
            process.terminate()
        assert process.wait(timeout=60) == 0
