"""The first hour of a newcomer, word for word: the tutorial and the README's table, typed into clean shells.

`make demo` and `make test` are not typed here: `.ci/run` gives both commands in a fresh clone on a machine that has
nothing but Python, git and make.
"""

from __future__ import annotations

import contextlib
import os
import pty
import re
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from service.people.person import Role
from tests.support.pages.accounts import PASSWORD
from tests.support.pages.browser import accept_on_page, invite_on_page, screen, set_up_administrator
from tests.support.pages.technician import Technician
from tests.support.processes.runners import no_runner_left
from tests.support.processes.waiting import until
from tests.support.rig.rig import REPOSITORY, RIG_LOCK

# A rig as people start it keeps the pace of a real one: a quarter of an hour, which a drawn test must not take.
pytestmark = [pytest.mark.slow, pytest.mark.whole(drawn=False), pytest.mark.timeout(5400)]

_BLOCK = re.compile(r"^```sh\n(.*?)^```", re.MULTILINE | re.DOTALL)
_ROW = re.compile(r"^\| .* \| `(orthocapture [^`]+)` \|$", re.MULTILINE)
_ESCAPE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\r")
_PEOPLE: dict[str, Role] = {"tina": "technician", "sam": "supervisor"}
STEP_S = 900  # after which a step, of minutes on a quiet machine, does not end any more


class Shell:
    """A terminal in a clone of the repository, whose environment has nothing of ours."""

    def __init__(self, clone: Path, home: Path) -> None:
        self._master, slave = pty.openpty()
        environment = {"HOME": str(home), "PATH": "/usr/bin:/bin", "TERM": "xterm", "PS1": "", "COLUMNS": "200"}
        self._shell = subprocess.Popen(
            ["setsid", "--ctty", "/bin/sh", "-i"], cwd=clone, env=environment,
            stdin=slave, stdout=slave, stderr=slave,
        )  # fmt: skip
        os.close(slave)
        self._shown = ""
        self._count = 0

    def type(self, line: str) -> None:
        """Type a line; only what is shown after it counts from now on."""
        self._read()
        self._shown = ""
        os.write(self._master, line.encode() + b"\n")

    def run(self, line: str, *, password: str = "", within_s: float = 600) -> tuple[int, str]:
        """Type a command, and the password if one is given; return its exit status and what it showed."""
        self._count += 1
        self.type(f"{line}; echo status-$?-{self._count}.")
        if password:
            self.wait_for("Password of")
            os.write(self._master, password.encode() + b"\n")
        found = self.wait_for(rf"status-(\d+)-{self._count}\.", within_s=within_s)
        return int(found[1]), self._shown

    def wait_for(self, pattern: str, *, within_s: float = 300) -> re.Match[str]:
        """Wait until what is shown matches, and return the match."""

        def appeared() -> bool:
            self._read()
            return re.search(pattern, self._shown) is not None

        until(appeared, lambda: f"{pattern} is not shown: {self._shown[-4000:]}", within_s=within_s)
        found = re.search(pattern, self._shown)
        assert found is not None
        return found

    def interrupt(self) -> None:
        """Press Ctrl-C."""
        os.write(self._master, b"\x03")

    def close(self) -> None:
        """End what runs in it, as a terminal's window does."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(os.tcgetpgrp(self._master), signal.SIGINT)
        with contextlib.suppress(AssertionError):  # it does not end: the shell's end will end it
            until(self._at_its_prompt, "it does not end", 60.0)
        self._shell.kill()
        self._shell.wait()
        os.close(self._master)

    def _at_its_prompt(self) -> bool:
        self._read()
        return os.tcgetpgrp(self._master) == self._shell.pid

    def _read(self) -> None:
        while select.select([self._master], [], [], 0)[0]:
            self._shown += _ESCAPE.sub("", os.read(self._master, 65536).decode(errors="replace"))


def blocks_of(document: str) -> list[list[str]]:
    """Return the lines of each shell block of a document."""
    return [block.splitlines() for block in _BLOCK.findall((REPOSITORY / document).read_text(encoding="utf-8"))]


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clone with the environment that `make demo` installs; what these tests run in stands for it."""
    folder = tmp_path_factory.mktemp("newcomer") / "orthocapture"
    subprocess.run(["git", "clone", "--quiet", "--depth", "1", f"file://{REPOSITORY}", folder], check=True)
    (folder / ".venv").symlink_to(sys.prefix)
    return folder


@pytest.fixture
def terminals(clone: Path, tmp_path: Path) -> Iterator[list[Shell]]:
    """Three terminals: of the rig, of the pages, and one to work in."""
    opened = [Shell(clone, tmp_path) for _ in range(3)]
    with RIG_LOCK, no_runner_left(clone / "runs"):
        yield opened
        for terminal in reversed(opened):
            terminal.close()


def test_the_tutorial_and_the_readme_lead_to_a_verified_run(
    clone: Path, terminals: list[Shell], browser: Browser
) -> None:
    demo, rig_block, serve_block, after = blocks_of("docs/tutorial/first_capture.md")
    readme = blocks_of("README.md")
    assert [demo, readme[0], readme[1]] == [["make demo"], ["make demo"], ["make test"]]
    rig, pages, work = terminals
    activate = rig_block[0]
    assert readme[2][0] == activate

    for line in rig_block:
        rig.type(line)
    rig.wait_for(r"orthocapture serve --rig rig/rig\.yaml")  # it says what to type next

    pages.type(activate)
    for line in serve_block:
        pages.type(line)
    set_up = pages.wait_for(r"http://\S+/set-up/[\w-]+")[0]
    url = set_up.partition("/set-up")[0]

    run = _complete_a_run(browser, url, set_up)

    work.type(activate)
    for line in after:
        status, shown = work.run(line, password=PASSWORD if "--operator" in line else "")
        assert status == 0, shown
    assert (clone / "report.pdf").read_bytes().startswith(b"%PDF")

    # "Now change one byte of a file under runs/artefacts and verify again: the file is named."
    changed = max((path for path in (clone / "runs" / "artefacts").rglob("*") if path.is_file()), key=_size_bytes)
    before = changed.read_bytes()
    changed.chmod(0o600)
    changed.write_bytes(before[:-1] + bytes([before[-1] ^ 1]))
    status, shown = work.run(next(line for line in after if "audit verify" in line))
    assert status != 0, shown
    assert changed.name[:12] in re.sub(r"\s", "", shown), shown
    changed.write_bytes(before)

    _type_the_table(work, run)


def _size_bytes(path: Path) -> int:
    return path.stat().st_size


def _complete_a_run(browser: Browser, url: str, set_up: str) -> str:
    """Make the accounts, and complete a run as its technician; returns the run's id."""
    with screen(browser, url) as tablet:
        set_up_administrator(tablet, set_up)
        links = [invite_on_page(tablet, account, role) for account, role in _PEOPLE.items()]
    for link in links:
        with screen(browser, url) as own:
            accept_on_page(own, link)
    with screen(browser, url) as tablet:
        tablet.sign_in("tina")
        technician = Technician(tablet)
        run = technician.start("Demonstration on a simulated rig")
        technician.complete_the_run(STEP_S)
        return run


def _type_the_table(work: Shell, run: str) -> None:
    """Type the README's commands of the first week; rig and pages are served already."""
    rows = _ROW.findall((REPOSITORY / "README.md").read_text(encoding="utf-8"))
    assert len(rows) == 10
    simulate, serve, doctor, check, begin, resume, *readers = rows
    assert "simulate rig" in simulate
    assert " serve " in serve
    for command in (doctor, check, *readers):
        acts = " audit report " in command or " export " in command
        status, shown = work.run(f"{command} --operator sam" if acts else command, password=PASSWORD if acts else "")
        assert status == 0, f"{command}: {shown}"
        assert run in shown or "latest" not in command, f"{command} does not name the run: {shown}"
    for command in (begin, resume):  # the name that stands there is that of a site without accounts
        work.type(f"{command} --operator tina")
        work.wait_for("Password of")
        work.type(PASSWORD)
        work.wait_for(r"Type one of: confirm")
        if command == begin:
            work.interrupt()
            work.wait_for(r"orthocapture resume")  # how to go on
    work.type("abort only reading the README")
    work.wait_for(r"is aborted")
