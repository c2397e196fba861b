"""Banners of driven robots on pages of other runs; runs in progress first; the sealed record."""

from __future__ import annotations

import re
from collections.abc import Generator
from pathlib import Path

import pytest

from service.core.records.run_events import OperatorAction, RunAborted
from service.monitor.snapshot import Snapshot, write_snapshot
from service.store.records import SITE
from tests.support.pages.web import Browser, WebSite, web_site

ELSEWHERE = ("/", "/account", "/accounts", "/audit", "/audit/site", "/nowhere")


@pytest.fixture
def web(tmp_path: Path) -> Generator[WebSite]:
    with web_site(tmp_path) as site:
        yield site


def tell(web: WebSite, run_id: str, **fields: object) -> None:
    """Write a snapshot as a runner does."""
    write_snapshot(web.site.data, run_id, Snapshot.model_validate({"at_utc_s": web.now_utc_s, **fields}))


def keys(page: str) -> list[str]:
    """The states of the robots that the page shows."""
    shown = re.sub(r'<template id="robots-lost">.*?</template>', "", page, flags=re.DOTALL)
    return re.findall(r'data-robot="(\w+)"', shown)


# --- robots --------------------------------------------------------------------------------------------------


def test_every_page_tells_how_a_driven_robot_stands(web: WebSite) -> None:
    browser = web.browser("administrator")
    run_id, other = web.begin_run().run_id, web.begin_run().run_id
    pages = (*ELSEWHERE, f"/audit/runs/{run_id}", f"/audit/runs/{other}/timeline", f"/runs/{run_id}/exports")
    for address in pages:
        assert keys(browser.get(address).text) == [], address
    web.site.launcher.start(run_id)
    tell(web, run_id, doing="working", robot="moving")
    for address in pages:
        page = browser.get(address).text
        assert keys(page) == ["moving"], address
        assert f'href="/runs/{run_id}"' in page
        assert 'data-poll="/robots"' in page
    assert keys(browser.get(f"/runs/{other}").text) == ["moving", "unknown"]
    assert f'data-poll="/robots?but={run_id}"' in browser.get(f"/runs/{run_id}").text
    assert keys(browser.get(f"/runs/{run_id}").text) == ["moving"]


def test_the_banners_follow_the_robot(web: WebSite) -> None:
    browser = web.browser("auditor")
    run_id = web.begin_run().run_id
    assert keys(browser.get("/robots").text) == []
    with web.store.lease(run_id, "runner", 60.0):
        for robot, key in (("protective_stop", "protective_stop"), ("standing", "standing")):
            tell(web, run_id, doing="asking", robot=robot)
            assert keys(browser.get("/robots").text) == [key]
        tell(web, run_id, at_utc_s=web.now_utc_s - 6, doing="asking", robot="standing")
        assert keys(browser.get("/robots").text) == ["unknown"]
        assert keys(browser.get("/robots", params={"but": run_id}).text) == []
    assert keys(browser.get("/robots").text) == []


def test_a_record_that_cannot_be_read_leaves_the_page_and_makes_the_robot_unknown(web: WebSite) -> None:
    browser = web.browser("administrator")
    run_id = web.begin_run().run_id
    web.site.launcher.start(run_id)
    tell(web, run_id, doing="working", robot="moving")
    protocol = next(a.ref.sha256 for a in web.store.artefacts(run_id) if a.ref.kind == "protocol")
    web.store.artefact_path(protocol).unlink()
    page = browser.get("/accounts")
    assert page.status_code == 200
    assert keys(page.text) == ["unknown"]


def test_nothing_is_told_to_whoever_is_not_signed_in(web: WebSite) -> None:
    web.site.launcher.start(web.begin_run().run_id)
    stranger = web.browser()
    assert keys(stranger.get("/sign-in").text) == []
    assert stranger.get("/robots", follow_redirects=False).status_code == 303


# --- the first page ------------------------------------------------------------------------------------------


def test_runs_under_way_come_first_of_all_runs(web: WebSite) -> None:
    browser = web.browser("technician")
    forgotten, aborted, driven = (web.begin_run().run_id for _ in range(3))
    web.store.record(aborted, [OperatorAction(action="abort", reason="no specimen")], actor="grace")
    for _ in range(14):
        ended = web.begin_run().run_id
        web.store.record(ended, [RunAborted(reason="a try")], actor="runner")
    web.site.launcher.start(driven)
    tell(web, driven, doing="working", robot="moving")
    first, second = (browser.get("/", params={"page": page}).text for page in (1, 2))
    assert listed(first, "under-way") == [driven, forgotten]
    assert len(listed(first, "recorded")) == 10
    assert listed(second, "under-way") == []
    assert listed(second, "recorded")[-1] == aborted
    assert len(listed(second, "recorded")) == 5


def listed(page: str, section: str) -> list[str]:
    """The runs of a section, in order."""
    _, _, after = page.partition(f'<h2 id="{section}">')
    return list(dict.fromkeys(re.findall(r'href="/runs/([\w-]+)"', after.partition("</section>")[0])))


# --- the sealed record ---------------------------------------------------------------------------------------


def signed_to(web: WebSite) -> int:
    """The last signed event of the site's chain."""
    return max((item.seq for item in web.store.checkpoints(SITE)), default=0)


def invite(browser: Browser, name: str) -> int:
    """Let the administrator send an invitation; returns the status."""
    return browser.send_form("/accounts", account=name, full_name="Tom Example", role="auditor").status_code


def test_the_sites_record_is_signed_with_every_change(web: WebSite) -> None:
    administrator, stranger = web.browser("administrator"), web.browser()
    assert signed_to(web) == 0
    for change in (
        lambda: invite(administrator, "tom"),
        lambda: stranger.sign_in("grace", "not her password").status_code,
        lambda: stranger.sign_in("grace").status_code,
        lambda: administrator.send_form("/accounts/tom/disable", reason="left").status_code,
    ):
        before = web.store.head(SITE)
        assert change() < 500
        assert web.store.head(SITE) > before
        assert signed_to(web) == web.store.head(SITE)


def test_what_cannot_be_signed_is_done_and_logged(web: WebSite, caplog: pytest.LogCaptureFixture) -> None:
    administrator = web.browser("administrator")
    assert invite(administrator, "tom") == 200
    signed = signed_to(web)
    (key,) = (web.site.data / "keys").glob("*.pem")
    content = key.read_bytes()
    key.unlink()
    assert invite(administrator, "tim") == 200
    assert "could not be signed" in caplog.text
    assert signed_to(web) == signed
    key.write_bytes(content)
    key.chmod(0o600)
    assert invite(administrator, "tam") == 200
    assert signed_to(web) == web.store.head(SITE)
