"""A technician with a tablet beside the table, who controls a run in progress from a screen."""

from __future__ import annotations

import contextlib
from collections.abc import Generator
from contextlib import contextmanager

from playwright.sync_api import Browser, expect

from service.core.records.events import Payload
from service.core.records.run_events import OperatorAction
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.store.store import Store
from tests.support.pages.browser import TABLET, Screen, Served, screen
from tests.support.pages.web import WebSite, password_of, web_site
from tests.support.runs.attended import attended
from tests.support.runs.bench_run import PROTOCOL, Bench

STANDING = {"doing": "asking", "robot": "standing", "robot_name": "robot"}


@contextmanager
def at_the_table(
    server: Served, browser: Browser, size: tuple[int, int] = TABLET, *, protocol: str = PROTOCOL, touch: bool = False
) -> Generator[tuple[Screen, str]]:
    """A technician's screen that controls her own run in progress."""
    with web_site(server.data.parent) as web:
        run_id = web.begin_run(protocol).run_id
    with attended(server.data, {run_id: STANDING}), screen(browser, server.url, size, touch=touch) as tablet:
        tablet.sign_in("grace", password_of("grace"))
        tablet.go(f"/runs/{run_id}")
        tablet.page.get_by_role("button", name="Take control").click()
        expect(tablet.page.locator(".main-action button")).to_be_visible()
        yield tablet, run_id


def record(server: Served, run_id: str, *payloads: Payload) -> None:
    """Record what happened meanwhile."""
    with Store.open(server.data) as store:
        store.record(run_id, list(payloads), actor="grace")


class _LeftError(BaseException):
    """The person has gone."""


def _leave(_question: AskOperator, _state: RunState) -> OperatorAction:
    raise _LeftError


def left_at(web: WebSite, step: str, question: str, protocol: str = PROTOCOL) -> Bench:
    """A run that waits for a person's answer to a question."""
    bench = web.begin_run(protocol)
    bench.script(step, question, _leave)
    with contextlib.suppress(_LeftError):
        bench.run()
    return bench
