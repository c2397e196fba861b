"""A protocol is its bytes: their approval is recorded, and the same version with other limits is flagged."""

from __future__ import annotations

import re
from collections.abc import Generator
from html import unescape
from pathlib import Path

import pytest

from service.core.errors import ConfigurationError
from service.core.protocol import LoadedProtocol, parse_protocol
from service.core.records.events import ProtocolApproved
from service.people.approvals import approve, difference, standing_of
from service.steps import params_models
from service.store.records import SITE
from service.store.verification.verify import verify
from tests.support.pages.web import WebSite, password_of, web_site
from tests.support.runs.bench_run import PROTOCOL

LOOSE = PROTOCOL.replace("{measure: viewpoints_captured, min: 3}", "{measure: viewpoints_captured, min: 1}").replace(
    "retries: 2", "retries: 9"
)


@pytest.fixture
def web(tmp_path: Path) -> Generator[WebSite]:
    with web_site(tmp_path) as site:
        yield site


def loaded(text: str) -> LoadedProtocol:
    return parse_protocol(text.encode(), params_models(), name="bench.yaml")


def words(html: str) -> str:
    return re.sub(r"\s+", " ", unescape(re.sub(r"<[^>]+>", " ", html)))


def approved(web: WebSite) -> list[tuple[str, ProtocolApproved]]:
    return [(e.actor, e.payload) for e in web.store.events(SITE) if isinstance(e.payload, ProtocolApproved)]


def test_the_first_who_begins_a_run_of_a_protocol_approves_it(web: WebSite) -> None:
    browser = web.browser("technician")
    assert "by starting it you approve this content" in words(browser.get("/").text)
    assert browser.send_form("/runs", protocol="bench.yaml", specimen="S1").status_code == 303
    assert browser.send_form("/runs", protocol="bench.yaml", specimen="S1").status_code in (303, 409)
    ((actor, record),) = approved(web)
    assert (actor, record.sha256, record.instead_of) == ("grace", loaded(PROTOCOL).sha256, "")
    assert "Approved by grace" in words(browser.get("/").text)


def test_another_content_under_the_same_version_needs_a_reason_and_a_signer(web: WebSite) -> None:
    approve(web.store, loaded(PROTOCOL), "emmy")
    (web.folder / "protocols" / "bench.yaml").write_text(LOOSE)
    browser = web.browser("technician")
    page = words(browser.get("/").text)
    assert "Changed Different content of bench 1 was approved by emmy" in page
    assert re.search(r"− \d+: - \{measure: viewpoints_captured, min: 3\}", page)
    assert re.search(r"\+ \d+: - \{measure: viewpoints_captured, min: 1\}", page)
    for fields in (
        {},
        {"reason": "pilot", "password": "guessed"},
        {"reason": "  ", "password": password_of("grace")},
    ):
        assert browser.send_form("/runs", protocol="bench.yaml", specimen="S1", **fields).status_code >= 400
    assert len(web.store.runs()) == 0
    sent = browser.send_form(
        "/runs", protocol="bench.yaml", specimen="S1", reason="one view is enough", password=password_of("grace")
    )
    assert sent.status_code == 303
    _, record = approved(web)[-1]
    assert (record.instead_of, record.reason, record.identified) == (
        loaded(PROTOCOL).sha256,
        "one view is enough",
        "password",
    )
    assert not standing_of(web.store, loaded(LOOSE)).changed
    assert verify(web.site.data, SITE).ok


def test_the_command_line_refuses_a_changed_content_without_a_reason(web: WebSite) -> None:
    approve(web.store, loaded(PROTOCOL), "emmy")
    with pytest.raises(ConfigurationError, match=r"another content than the one that emmy approved.*min: 1"):
        approve(web.store, loaded(LOOSE), "Ada", identified="claimed")
    assert approve(web.store, loaded(LOOSE), "Ada", reason="pilot", identified="claimed").approval is not None
    assert len(approved(web)) == 2


def test_the_auditor_sees_which_limits_and_what_differs(web: WebSite) -> None:
    approve(web.store, loaded(PROTOCOL), "emmy")
    strict = web.record_run()
    assert "is not always the same protocol" not in first_page(web, strict)
    approve(web.store, loaded(LOOSE), "grace", reason="one view is enough")
    loose = web.record_run(LOOSE)
    page = first_page(web, loose)
    assert "bench 1 is not always the same protocol here" in page
    assert strict in page
    assert re.search(r"\+ \d+: - \{measure: viewpoints_captured, min: 1\}", page)
    assert "“one view is enough”" in page
    assert f"Judged against the limits in bench 1, SHA-256 {loaded(LOOSE).sha256} , which grace approved" in page
    assert "is not always the same protocol" in first_page(web, strict)


def first_page(web: WebSite, run_id: str) -> str:
    """The first page, once the digest, computed in the background, is ready."""
    page = ""
    while "Re-dos" not in page:
        page = words(web.browser("auditor").get(f"/audit/runs/{run_id}").text)
    return page


def test_lines_are_numbered_on_either_side() -> None:
    assert difference("a\nb\nc\n", "a\nB\nc\nd\n") == ["− 2: b", "+ 2: B", "+ 4: d"]


def test_each_of_several_lines_has_its_own_number() -> None:
    assert difference("a\nb\nc\nd", "a\nx\ny\nz\nd") == ["− 2: b", "− 3: c", "+ 2: x", "+ 3: y", "+ 4: z"]
