"""The web application in this process, over a test's data folder, with signed-in people of every role."""

from __future__ import annotations

import warnings
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
from anyio.from_thread import BlockingPortal, start_blocking_portal
from fastapi import FastAPI

from service.people.control import Control
from service.people.person import ROLES, Person, Role
from service.people.sessions import People
from service.rig import load_rig
from service.station import devices_of
from service.store.durable_effects import Clock
from service.store.store import Store
from service.web.app import create_app
from service.web.security import cookie_name
from service.web.site import Launcher, Site
from tests.support.pages.compiled_templates import keep_compiled_templates
from tests.support.processes.forked import pages_fork
from tests.support.processes.quick_hashes import QuickHasher
from tests.support.record.outsider import copy_data
from tests.support.record.stepped_clock import SteppedClock
from tests.support.runs.bench_run import PROTOCOL, Bench, begin_run

with warnings.catch_warnings():
    # Starlette's test client warns that it prefers httpx's successor, which this project does not use otherwise.
    warnings.simplefilter("ignore")
    from starlette.testclient import TestClient

HOST = "https://testserver"
PIN = "2468"
QUICK_HASHES = QuickHasher()
NAMES: dict[Role, str] = {
    "technician": "Grace Hopper",
    "supervisor": "Emmy Noether",
    "auditor": "Lise Meitner",
    "administrator": "Ada Lovelace",
}
ACCOUNT_OF: dict[Role, str] = {role: name.split()[0].lower() for role, name in NAMES.items()}


def password_of(account: str) -> str:
    """The password of an account in tests."""
    return f"correct horse {account.lower()}"


class NoLauncher(Launcher):
    """Starts nothing, but remembers what it was asked to start."""

    started: list[str]

    def start(self, run_id: str) -> None:
        self.__dict__.setdefault("started", []).append(run_id)

    def driven(self, run_id: str) -> bool:
        return run_id in self.__dict__.get("started", []) or self.store.driven(run_id)

    def driven_runs(self) -> list[str]:
        return sorted({*self.__dict__.get("started", []), *self.store.driven_runs()})


class Browser(TestClient):
    """A screen: keeps its cookie and sends its CSRF token with every POST unless told otherwise."""

    site: Site

    @property
    def token(self) -> str:
        return self.cookies.get(cookie_name(self.site), "") or ""

    @property
    def person(self) -> Person:
        """The signed-in person."""
        person = self.site.people.person(self.token, idle_lock_s=1e9, deliberate=False)
        assert person is not None, "nobody is signed in on this screen"
        return person

    def send_form(self, address: str, *, csrf: str | None = None, **fields: Any) -> httpx.Response:
        """POST a form as the page does, without following the redirect."""
        token = self.person.csrf if csrf is None else csrf
        return self.post(address, data={"csrf": token, **fields}, follow_redirects=False)

    def sign_in(self, account: str, password: str | None = None, **more: str) -> httpx.Response:
        """Sign in through the page."""
        fields = {"account": account, "password": password_of(account) if password is None else password, **more}
        return self.post("/sign-in", data=fields, follow_redirects=False)


@dataclass
class WebSite:
    """A site with its four people. `as_technician` and so on are screens on which they are signed in."""

    site: Site
    app: FastAPI
    folder: Path
    portal: BlockingPortal  # the event loop in which the application serves all screens
    browsers: list[Browser] = field(default_factory=list[Browser])

    @property
    def store(self) -> Store:
        return self.site.store

    @property
    def now_utc_s(self) -> float:
        """The site's time, in seconds since the epoch."""
        return self.store.clock.utc_s()

    @property
    def people(self) -> People:
        return self.site.people

    def browser(self, role: Role | None = None) -> Browser:
        """A new screen; with a role, signed in as its person. Server errors become pages."""
        browser = Browser(self.app, base_url=HOST, raise_server_exceptions=False)
        browser.site = self.site
        browser.portal = self.portal  # without it every request would start a loop and a thread of its own
        self.browsers.append(browser)
        if role is not None:
            account = ACCOUNT_OF[role]
            token = self.people.sign_in(account, password_of(account), address="testclient")
            browser.cookies.set(cookie_name(self.site), token, domain="testserver.local", path="/")
        return browser

    def account(self, role: Role) -> str:
        """The account that has the role."""
        return ACCOUNT_OF[role]

    def begin_run(self, protocol: str = PROTOCOL) -> Bench:
        """Begin a run, which waits for its first confirmation."""
        return begin_run(self.store, protocol, self.folder)

    def record_run(self, protocol: str = PROTOCOL) -> str:
        """Record a small completed run on the in-memory rig."""
        bench = self.begin_run(protocol)
        state = bench.run()
        assert state.status == "completed", state.status
        return bench.run_id

    def take_control(self, run_id: str, browser: Browser) -> None:
        """Let this screen control the run from now on."""
        Control(self.store).take(run_id, browser.person)


@contextmanager
def web_site(folder: Path, *, clock: Clock | None = None, idle_lock_s: float = 600.0) -> Generator[WebSite]:
    """A site over folder/data with a simulated rig without devices and one protocol file, bench.yaml.

    Time stands still there, but for waits, unless another clock is given.
    """
    keep_compiled_templates()
    rig_file = folder / "rig.yaml"
    rig_file.write_text("name: bench\nsimulated: true\ndevices: {}\n")
    protocols = folder / "protocols"
    protocols.mkdir(exist_ok=True)
    (protocols / "bench.yaml").write_text(PROTOCOL)
    data = folder / "data"
    if clock is None and not data.exists():
        copy_data(Path(_with_people().name) / "data", data)
    clock = clock or SteppedClock.from_now()
    with Store.open(data, clock) as store, start_blocking_portal() as portal, pages_fork():
        people = People(store, QUICK_HASHES)
        populate(people)
        site = Site(
            data=data,
            rig=load_rig(rig_file),
            protocols=protocols,
            store=store,
            people=people,
            launcher=NoLauncher(data, store),
            devices_of=devices_of,
            idle_lock_s=idle_lock_s,
            hosts=("testserver",),
        )
        whole = WebSite(site, create_app(site), folder, portal)
        try:
            yield whole
        finally:
            for browser in whole.browsers:
                browser.close()


@cache
def _with_people() -> TemporaryDirectory[str]:
    """A folder with data of nothing but the four people, made once in a process: most of the work for a site."""
    folder = TemporaryDirectory(prefix="people-")
    with Store.open(Path(folder.name) / "data") as store:
        populate(People(store, QUICK_HASHES))
    return folder


def populate(people: People) -> None:
    """Create the four people as in practice: by a first link and invitations."""
    first = people.first_link()
    if first is None:
        return
    name = ACCOUNT_OF["administrator"]
    people.accounts.set_up(first, name, NAMES["administrator"], password_of(name), PIN)
    by = people.person(people.sign_in(name, password_of(name)), idle_lock_s=1e9, deliberate=False)
    assert by is not None
    for role in ROLES:
        if role != "administrator":
            account = ACCOUNT_OF[role]
            people.accounts.accept(people.accounts.invite(by, account, NAMES[role], role), password_of(account), PIN)
    people.sign_out(by)
