"""Requests about a run that has ended are refused and recorded in the site's chain: the run stays sealed."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.core.records.events import ActionAfterEnd
from service.core.records.run_events import ActionRefused
from service.store.records import SITE
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.web import WebSite, password_of, web_site


@pytest.fixture
def web(tmp_path: Path) -> Generator[WebSite]:
    with web_site(tmp_path) as site:
        yield site


def after_the_end(store: Store) -> list[ActionAfterEnd]:
    return [e.payload for e in store.events(SITE) if isinstance(e.payload, ActionAfterEnd)]


def test_on_the_screen(web: WebSite) -> None:
    run_id = web.record_run()
    head, deviations = web.store.head(run_id), len(web.site.run(run_id).state.deviations)
    browser = web.browser("technician")
    web.take_control(run_id, browser)
    head = web.store.head(run_id)
    refused = browser.send_form(f"/runs/{run_id}/actions", verb="abort", reason="the board slipped")
    assert refused.status_code >= 400
    assert web.store.head(run_id) == head
    assert len(web.site.run(run_id).state.deviations) == deviations
    (wanted,) = after_the_end(web.store)
    assert (wanted.run, wanted.action) == (run_id, "abort")
    assert "completed" in wanted.why
    found = web.browser("auditor").get("/audit/site", params={"kind": "action_after_end"}).text
    assert run_id in found or "Action after end" in found
    assert verify(web.site.data, run_id).ok
    assert verify(web.site.data, SITE).ok


def test_nobody_takes_control_of_it_any_more(web: WebSite) -> None:
    run_id = web.record_run()
    head = web.store.head(run_id)
    for way in ("take", "ask"):
        assert web.browser("technician").send_form(f"/runs/{run_id}/control/{way}").status_code >= 400
    assert web.store.head(run_id) == head


def test_in_the_terminal(web: WebSite) -> None:
    run_id = web.record_run()
    head = web.store.head(run_id)
    data = str(web.site.data)
    words = ["act", "redo", "--run", run_id, "--step", "capture", "--reason", "again", "--operator", "grace"]
    answer = CliRunner().invoke(app, [*words, "--password-stdin", "--data", data], input=password_of("grace") + "\n")
    assert answer.exit_code != 0, answer.output
    assert web.store.head(run_id) == head
    assert [(one.run, one.action) for one in after_the_end(web.store)] == [(run_id, "redo")]


def test_in_a_run_that_goes_on_the_refusal_stays_with_it(web: WebSite) -> None:
    run_id = web.begin_run().run_id
    browser = web.browser("technician")
    web.take_control(run_id, browser)
    head = web.store.head(run_id)
    browser.send_form(f"/runs/{run_id}/actions", verb="resume", step="fixation", attempt=1, seen_seq=head)
    refused = [e.payload for e in web.store.events(run_id) if isinstance(e.payload, ActionRefused)]
    assert [one.action for one in refused] == ["resume"]
    assert after_the_end(web.store) == []
