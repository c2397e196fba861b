"""The audit's pages on a large run: who may read and change what, what comes first, filters, and hostile requests."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import quote

import pytest
from fastapi.routing import APIRoute

from service.audit import overview
from service.people.person import may
from service.store.verification.verify import verify
from service.web import audit, audit_overview
from tests.support.pages.web import WebSite, web_site
from tests.support.processes.waiting import until
from tests.support.record.outsider import rows, tamper
from tests.support.recorded.large_run import digest_of
from tests.support.runs.recorded_run import record_run


def addresses(web: WebSite, run: str) -> list[str]:
    here = f"/audit/runs/{run}"
    (sha256,) = rows(web.site.data, "SELECT sha256 FROM artefacts WHERE kind = 'live_view' LIMIT 1")[0]
    tabs = ("timeline", "artefacts", "provenance", "corrections", "signatures", "devices", "verification")
    return [
        "/audit",
        "/audit/site",
        "/audit/site/events/1",
        here,
        f"{here}/deviations",
        f"{here}/events/1",
        f"{here}/artefacts/{sha256}",
        *(f"{here}/{tab}" for tab in tabs),
    ]


def settle(web: WebSite, address: str) -> str:
    browser, page = web.browser("auditor"), ""

    def complete() -> bool:
        nonlocal page
        answer = browser.get(address)
        assert answer.status_code == 200, (address, answer.text[:300])
        page = answer.text
        return "data-pending" not in page

    until(complete, f"{address} is still being computed", every_s=0.05)
    return page


@pytest.mark.slow
def test_every_page_can_be_read_by_every_role_and_by_nobody_else(web: WebSite, run: str) -> None:
    assert all(may(role, "read") for role in ("technician", "supervisor", "auditor", "administrator"))
    for address in addresses(web, run):
        assert "<h1" in settle(web, address)
        answer = web.browser().get(address, follow_redirects=False)
        assert (answer.status_code, answer.headers["location"].split("?")[0]) == (303, "/sign-in")


def test_first_page_shows_deviations_before_everything_else(web: WebSite, run: str) -> None:
    text = settle(web, f"/audit/runs/{run}")
    headings = re.findall(r"<h2[^>]*>(.*?)</h2>", text.split("<main", 1)[1])
    digest = digest_of(web.store, run)
    assert headings[0] == f'Deviations <span class="muted num">{len(digest.deviations)}</span>'
    for group, number in overview.counts(digest).items():
        name = overview.GROUPS[group][0]
        assert re.search(rf'count-number num">{number}</span> <span class="count-name">{name}<', text), group
    assert "Simulated" in text
    assert "a hand in the picture 0" in text


@pytest.mark.slow
def test_auditors_change_nothing_but_may_verify(web: WebSite, run: str) -> None:
    modules = (audit_overview, audit, audit)
    routes = [route for page in modules for route in page.router.routes]
    posts = [r for r in routes if isinstance(r, APIRoute) and "POST" in (r.methods or ())]
    assert {route.name for route in posts} == {"correct", "verify"}
    auditor = web.browser("auditor")
    fields = {"of_seq": "2", "field": "host", "new": "x", "reason": "y"}
    before = len(web.store.events(run))
    assert auditor.send_form(f"/audit/runs/{run}/corrections", **fields).status_code == 403
    assert auditor.send_form(f"/audit/runs/{run}/verification", csrf="stolen").status_code == 403
    assert len(web.store.events(run)) == before
    assert auditor.send_form(f"/audit/runs/{run}/verification").status_code == 303
    web.app.state.audit.verifications.wait(run, 60)
    text = settle(web, f"/audit/runs/{run}/verification")
    assert "Verifies" in text
    assert len(web.store.events(run)) == before
    assert verify(web.site.data, run).ok


def test_supervisor_corrects_and_everybody_sees_both_values(web: WebSite, run: str) -> None:
    supervisor = web.browser("supervisor")
    assert "Correct a value" in supervisor.get(f"/audit/runs/{run}/events/2").text
    assert "Correct a value" not in web.browser("auditor").get(f"/audit/runs/{run}/events/2").text
    fields = {"of_seq": "2", "field": "host", "new": "<b>the table</b>", "reason": "named & wrong"}
    assert supervisor.send_form(f"/audit/runs/{run}/corrections", **fields).status_code == 303
    text = settle(web, f"/audit/runs/{run}/corrections")
    assert "&lt;b&gt;the table&lt;/b&gt;" in text
    assert "named &amp; wrong" in text
    assert web.store.events(run)[-1].actor == web.account("supervisor")
    for wrong in ({"field": "absent"}, {"new": "here"}, {"of_seq": "99999999"}, {"reason": ""}, {"of_seq": "-1"}):
        answer = supervisor.send_form(f"/audit/runs/{run}/corrections", **fields | wrong)
        assert 400 <= answer.status_code < 500, wrong


def test_faults_of_a_verification_are_listed(tmp_path: Path) -> None:
    run = record_run(tmp_path)
    tamper(tmp_path / "data", "UPDATE events SET actor = 'Eve' WHERE seq = 3")
    with web_site(tmp_path) as web:
        web.browser("auditor").send_form(f"/audit/runs/{run}/verification")
        web.app.state.audit.verifications.wait(run, 60)
        text = settle(web, f"/audit/runs/{run}/verification")
        assert "Does not verify" in text
        assert f"/audit/runs/{run}/events/3" in text
        assert "the content was altered" in text
        assert "Does not verify" in settle(web, "/audit?unverified=1")
        assert "Altered" in settle(web, f"/audit/runs/{run}/events/3")


def test_runs_are_filtered(web: WebSite, run: str) -> None:
    settle(web, "/audit")
    for query, listed in (
        ("q=demo", True),
        ("q=nothing+like+it", False),
        ("status=completed", True),
        ("status=active", False),
        ("simulated=no", False),
        ("simulated=yes&deviations=1", True),
        ("person=Grace", True),
        ("person=Eve", False),
        ("since=2000-01-01&until=2099-01-01", True),
        ("until=2000-01-01", False),
        ("since=tomorrow'", False),
        ("protocol=demo&page=-7", True),
        ("protocol=%01", False),
    ):
        assert (run in settle(web, f"/audit?{query}")) == listed, query


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("timeline?q=" + quote("\"%_* OR NOT NEAR( ' " + "a" * 10_000), 200),
        ("timeline?q=%00%ff%ed%a0%80&kind=%27%3B--", 200),
        ("timeline?after=-5&before=-9", 200),
        ("timeline?after=99999999999999999999999999&before=0", 200),
        ("timeline?after=x", 422),
        ("artefacts?page=-1&q=%25_%5C", 200),
        ("artefacts?page=99999999999999999999999999", 200),
        ("artefacts/" + "f" * 64, 404),
        ("artefacts/..%2F..%2Fetc%2Fpasswd", 404),
        ("events/0", 404),
        ("events/99999999999999999999999999", 404),
        ("events/one", 422),
        ("deviations?group=%3Cscript%3E&page=0", 200),
        ("corrections?page=-3", 200),
    ],
)
def test_hostile_requests_get_an_honest_page(web: WebSite, run: str, path: str, status: int) -> None:
    answer = web.browser("auditor").get(f"/audit/runs/{run}/{path}")
    assert answer.status_code == status
    assert "Traceback" not in answer.text
    assert "<script>" not in answer.text.lower()


@pytest.mark.parametrize("name", ["nope", "site", "%00", "..", "'"])
def test_unknown_runs_are_not_found(web: WebSite, name: str) -> None:
    assert web.browser("auditor").get(f"/audit/runs/{name}/timeline").status_code == 404
