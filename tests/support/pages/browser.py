"""Browser tests of the served pages: Chromium, screens, `orthocapture serve` as a process, axe."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from axe_playwright_python.base import AXE_SCRIPT
from playwright.sync_api import Browser, BrowserContext, Locator, Page, Route, expect, sync_playwright

from service.people.person import Role
from tests.support.pages.accounts import PASSWORD, PIN
from tests.support.processes.forked import Forked
from tests.support.processes.runners import end_runners
from tests.support.rig.rig import REPOSITORY, command

TABLET = (1024, 768)
DESKTOP = (1920, 1080)
_FAILURES = REPOSITORY / "build" / "browser-failures"  # screenshots of failed tests
# The first is the same engine without the interface of a desktop browser, which costs three times as much.
_NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
# Without the last options a browser looks up its vendor's hosts at every start. SwiftShader draws the 3D view.
_OPTIONS = (
    "--no-sandbox",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
_RULES = {
    "runOnly": {"type": "tag", "values": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa"]},
    "resultTypes": ["violations"],  # passes are only counted
}


#: How long a page may take for anything that a test waits for: on a busy machine, and where it makes a scene first.
PATIENCE_MS = 60_000


@contextmanager
def chromium() -> Generator[Browser]:
    """The system's Chromium, headless."""
    expect.set_options(timeout=PATIENCE_MS)
    path = next((found for name in _NAMES if (found := shutil.which(name))), None)
    if path is None:
        pytest.fail(
            "Chromium is not installed, and the browser tests need it: "
            "`sudo apt-get install chromium-headless-shell` on Debian, `sudo snap install chromium` on Ubuntu, "
            "`brew install --cask chromium` on macOS",
            pytrace=False,
        )
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=_OPTIONS)
        try:
            yield browser
        finally:
            browser.close()


@dataclass
class Served:
    """`orthocapture serve` as a process, which can be killed and restarted on the same port."""

    rig: Path
    data: Path
    options: tuple[str, ...] = ()
    url: str = ""
    set_up: str = ""
    _process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Start the process and wait until it answers."""
        port = self.url.rpartition(":")[2] or "0"
        words = ["serve", "--rig", str(self.rig), "--data", str(self.data), "--port", port, "--json", *self.options]
        with (self.data.parent / "serve.log").open("a") as log:
            self._process = Forked(
                command(*words),
                cwd=REPOSITORY,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        assert line, self.log()
        ready = json.loads(line)
        self.url, self.set_up = ready["url"], ready["set_up"]

    def kill(self, how: signal.Signals = signal.SIGKILL) -> None:
        """Kill the process; the processes that it started continue."""
        if self._process is not None:
            self._process.send_signal(how)
            self._process.wait(timeout=20)
            assert self._process.stdout is not None
            self._process.stdout.close()
            self._process = None

    def log(self) -> str:
        """The output of the process and its runners."""
        logs = [self.data.parent / "serve.log", *(self.data / "monitor").glob("*.log")]
        return "\n".join(f"{path.name}: {path.read_text()}" for path in logs if path.exists())

    def end_runners(self) -> None:
        """End the processes that drive runs, and wait for them."""
        end_runners(self.data)


class Cable:
    """A connection from one screen to the server that can be interrupted: no data passes, but nothing is closed."""

    def __init__(self, url: str) -> None:
        self._target = ("127.0.0.1", int(url.rpartition(":")[2]))
        self._plugged = threading.Event()
        self._plugged.set()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """Hold back every byte from now on."""
        self._plugged.clear()

    def plug(self) -> None:
        """Deliver the bytes held back."""
        self._plugged.set()

    def close(self) -> None:
        """Accept no further connection."""
        self.plug()
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # already closed
            while True:
                near, _ = self._listener.accept()
                threading.Thread(target=self._join, args=(near,), daemon=True).start()

    def _join(self, near: socket.socket) -> None:
        with near, contextlib.suppress(OSError), socket.create_connection(self._target) as far:
            back = threading.Thread(target=self._copy, args=(far, near), daemon=True)
            back.start()
            self._copy(near, far)
            back.join()

    def _copy(self, source: socket.socket, target: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(1 << 16):
                self._plugged.wait()
                target.sendall(data)
            target.shutdown(socket.SHUT_WR)


@contextmanager
def served(rig: Path, data: Path, *options: str) -> Generator[Served]:
    """Serve the pages of a data folder until the block ends."""
    server = Served(rig, data, options)
    server.start()
    try:
        yield server
    finally:
        server.end_runners()
        server.kill(signal.SIGTERM)


def fill_secrets(page: Page) -> None:
    """Fill in the new password and the PIN wherever the page asks for one."""
    passwords = page.locator("input[type=password]:visible")
    for i in range(passwords.count()):
        is_pin = "pin" in (passwords.nth(i).get_attribute("name") or "")
        passwords.nth(i).fill(PIN if is_pin else PASSWORD)


@dataclass
class Screen:
    """A tablet or a desktop with one person in front of it."""

    context: BrowserContext
    page: Page
    url: str

    def go(self, path: str) -> None:
        """Open a page, which must load."""
        response = self.page.goto(self.url + path)
        assert response is not None, f"{path}: no answer"
        assert response.ok, f"{path}: {response.status}"

    def sign_in(self, account: str, password: str = PASSWORD) -> None:
        """Sign in through the page."""
        self.go("/sign-in")
        self.page.get_by_label("Account").fill(account)
        self.page.get_by_label("Password").fill(password)
        self.page.get_by_role("button", name="Sign in").click()
        expect(self.page.get_by_role("button", name="Sign out")).to_be_visible()

    def words(self) -> str:
        """The text of the page."""
        return self.page.locator("body").inner_text()

    def hold(self, name: str, seconds: float = 1.8) -> None:
        """Press the button of that name and hold it."""
        button = self.page.get_by_role("button", name=name)
        expect(button).to_be_enabled()
        button.scroll_into_view_if_needed()
        button.hover()
        self.page.mouse.down()
        self.page.wait_for_timeout(1000 * seconds)
        self.page.mouse.up()


def set_up_administrator(first: Screen, link: str) -> None:
    """Set up Ada, the administrator, by the link that `serve` prints, and sign in."""
    page = first.page
    page.goto(link)
    page.get_by_label("Your name").fill("Ada Example")
    page.get_by_label("Account, to sign in with").fill("ada")
    fill_secrets(page)
    page.get_by_role("button", name="Set up the account").click()
    if page.get_by_role("button", name="Sign out").count() == 0:
        first.sign_in("ada")


def invite_on_page(administrator: Screen, account: str, role: Role) -> str:
    """Invite a person on the page Accounts; returns the one-time link."""
    administrator.go("/accounts")
    page = administrator.page
    page.get_by_label("Name, as records and signatures show it").fill(f"{account.title()} Example")
    page.get_by_label("Account, to sign in with").fill(account)
    page.get_by_role("combobox", name="Role").select_option(role)
    page.get_by_role("button", name="Make a one-time link").click()
    return page.locator(".once").inner_text()


def accept_on_page(own: Screen, link: str) -> None:
    """Set up the account of a one-time link."""
    own.page.goto(link)
    fill_secrets(own.page)
    own.page.get_by_role("button", name=re.compile("Set up|account", re.IGNORECASE)).click()
    expect(own.page.get_by_text("The account is ready")).to_be_visible()


@contextmanager
def screen(
    browser: Browser, url: str, size: tuple[int, int] = TABLET, *, dark: bool = False, touch: bool = False
) -> Generator[Screen]:
    """A screen whose page must be free of errors: script errors and blocked content fail the test.

    Its person wants no motion: an icon that glances is painted sixty times a second, on the processor.
    """
    context = browser.new_context(
        viewport={"width": size[0], "height": size[1]},
        color_scheme="dark" if dark else "light",
        reduced_motion="reduce",
        has_touch=touch,
        base_url=url,
    )
    complaints: list[str] = []
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on(
        "console", lambda message: complaints.append(message.text) if "Content Security" in message.text else None
    )
    try:
        yield Screen(context, page, url)
    except BaseException:
        _FAILURES.mkdir(parents=True, exist_ok=True)
        page.screenshot(path=_FAILURES / f"{time.time():.1f}.png", full_page=True)
        raise
    finally:
        context.close()
    assert not complaints, complaints


@contextmanager
def scripts_held_back(page: Page) -> Generator[Callable[[], None]]:
    """Keep the page's scripts on their way, as a slow network does, until what is yielded is called."""
    waiting: list[Route] = []
    page.route("**/*.js", lambda route: waiting.append(route))  # noqa: PLW0108 - the library marks its handlers

    def come() -> None:
        while waiting:
            waiting.pop().continue_()
        page.unroute("**/*.js")

    yield come


def follow(link: Locator) -> None:
    """Click a link, and wait until the page behind it has loaded, its scripts included."""
    with link.page.expect_navigation():
        link.click()


def accessibility_faults(page: Page) -> list[str]:
    """What axe reports against WCAG 2.2 AA: the rule and the place."""
    if not page.evaluate("'axe' in window"):  # half a megabyte
        page.evaluate(AXE_SCRIPT)
    violations: list[dict[str, Any]] = page.evaluate(
        "rules => axe.run(rules).then(found => found.violations)", _RULES
    )
    return [
        f"{violation['id']}: {violation['help']} at {node['target']}: {node['html'][:120]}"
        for violation in violations
        for node in violation["nodes"]
    ]


def press_until(button: Locator, done: Callable[[], bool], *, hold_ms: float = 0, within_s: float = 20.0) -> None:
    """Press Enter on a button, or hold it, and wait; once more if the page took the focus for a step that came up."""
    keyboard = button.page.keyboard
    for _ in range(3):
        button.focus()
        keyboard.down("Enter")
        button.page.wait_for_timeout(hold_ms)
        keyboard.up("Enter")
        deadline_s = time.monotonic() + within_s
        while time.monotonic() < deadline_s:
            if done():
                return
            button.page.wait_for_timeout(100)
    raise AssertionError(f"pressed three times in vain: {button}")
