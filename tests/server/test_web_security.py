"""Security of the pages: headers, cookies, one-time links, limits, hostile input, errors that reveal nothing."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import httpx
import pytest
from fastapi.routing import iter_route_contexts
from hypothesis import HealthCheck, Phase, given, seed, settings

from service.people.person import ROLES, Role, may
from service.web.security import CONTENT_SECURITY_POLICY, SAFETY_HEADERS
from tests.support.pages.web import HOST, PIN, Browser, WebSite, web_site

if TYPE_CHECKING:
    from schemathesis import Case
    from schemathesis.schemas import APIOperation

HOSTILE = (
    "..",
    "../../../../etc/passwd",
    "..\\..\\windows\\win.ini",
    "/etc/passwd",
    "%2e%2e/%2e%2e",
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "'; DROP TABLE events; --",
    "{{ 7 * 7 }}",
    "\x00",
    "a\x00.jpg",
    "\r\nSet-Cookie: a=b",
    "\u202egnp.exe",
    "😀" * 20,
    "A" * 3000,
    "-1",
    "9" * 40,
    "~",
    "CON",
)


def must_be_shielded(answer: httpx.Response) -> None:
    """Check the security headers, and that nothing internal is revealed."""
    for name in SAFETY_HEADERS:
        assert name in answer.headers, (answer.url, name)
    assert "cache-control" in answer.headers, answer.url
    assert "Traceback" not in answer.text, answer.url
    assert 'File "' not in answer.text, answer.url


# --- headers and cookies -------------------------------------------------------------------------------------


def test_headers_on_whatever_is_answered(site: WebSite, run_id: str) -> None:
    browser, stranger = site.browser("technician"), site.browser()
    answers = [
        stranger.get("/sign-in"),
        stranger.get("/", follow_redirects=False),
        stranger.get("/nowhere"),
        stranger.get("/sign-in", headers={"host": "elsewhere.example"}),
        stranger.post("/sign-in", content=b"x" * 2_000_000),
        stranger.delete("/sign-in"),
        stranger.post("/sign-in", data={}),
        stranger.get("/openapi.json"),
        stranger.get("/static/orthocapture.css"),
        stranger.get("/static/nowhere.css"),
        browser.get("/account"),
        browser.get("/accounts"),
        browser.get(f"/runs/{run_id}"),
        browser.get("/runs/nowhere"),
        browser.post("/lock", data={"csrf": "wrong"}),
    ]
    for answer in answers:
        must_be_shielded(answer)
    assert [a.status_code for a in answers] == [
        200, 303, 404, 421, 413, 405, 422, 404, 200, 404, 200, 403, 200, 404, 403,
    ]  # fmt: skip
    assert answers[0].headers["content-security-policy"] == CONTENT_SECURITY_POLICY
    assert answers[0].headers["cache-control"] == "no-store"


def test_the_policy_of_pages_allows_no_inline_script() -> None:
    assert "'unsafe" not in CONTENT_SECURITY_POLICY
    assert "default-src 'none'" in CONTENT_SECURITY_POLICY
    assert "//" not in CONTENT_SECURITY_POLICY  # no other host


def test_pages_have_no_inline_script_or_style(site: WebSite, run_id: str) -> None:
    pages: tuple[tuple[Role, str], ...] = (
        ("technician", f"/runs/{run_id}"),
        ("administrator", "/accounts"),
        ("auditor", "/account"),
    )
    for role, address in pages:
        page = site.browser(role).get(address).text
        assert re.findall(r"<script(?![^>]*\bsrc=)[^>]*>", page) == []
        assert re.findall(r"\s(?:style|on[a-z]+)=\"", page) == []
        assert re.findall(r"(?:src|href)=\"(?:https?:)?//", page) == []


# --- limits --------------------------------------------------------------------------------------------------


def test_large_requests_are_refused_however_they_come(site: WebSite) -> None:
    def chunks() -> Iterator[bytes]:
        for _ in range(30):
            yield b"a" * 50_000

    browser = site.browser("technician")
    form = {"content-type": "application/x-www-form-urlencoded", "x-csrf-token": browser.person.csrf}
    assert browser.post("/lock", content=chunks(), headers=form).status_code == 413
    assert browser.post("/lock", content=b"a" * 1_500_000, headers=form).status_code == 413
    assert not browser.person.locked


@pytest.mark.parametrize("host", ["elsewhere.example", "testserver.elsewhere.example", "", "[", "testserver@evil"])
def test_names_that_this_site_does_not_have(site: WebSite, host: str) -> None:
    assert site.browser().get("/sign-in", headers={"host": host}).status_code == 421


@pytest.mark.parametrize("host", ["testserver", "TESTSERVER:8000", "127.0.0.1:8000", "[::1]:8000"])
def test_names_and_addresses_that_it_has(site: WebSite, host: str) -> None:
    assert site.browser().get("/sign-in", headers={"host": host}).status_code == 200


# --- hostile input -------------------------------------------------------------------------------------------


# A way out of a folder, an element, a header: these in every submission, of the others a tenth.
FIRST = ("../../../../etc/passwd", "<script>alert(1)</script>", "\r\nSet-Cookie: a=b")


@pytest.mark.parametrize(
    "hostile", [pytest.param(hostile, marks=pytest.mark.sweep(always=hostile in FIRST)) for hostile in HOSTILE]
)
def test_hostile_names_in_addresses(site: WebSite, run_id: str, hostile: str) -> None:
    browser = site.browser("supervisor")
    for context in iter_route_contexts(site.app.routes):
        path = context.path or ""
        if "{" not in path or "GET" not in (context.methods or ()):
            continue
        for name in re.findall(r"{([^}]*)}", path):
            rest = path.replace(f"{{{name}}}", quote(hostile, safe=""))
            address = re.sub(r"{[^}]*}", "1", rest.replace("{run_id}", run_id))
            answer = browser.get(address, follow_redirects=False)
            must_be_shielded(answer)
            assert answer.status_code < 500, (address, answer.text)
            assert "<script>alert" not in answer.text, address
            assert "<img src=x" not in answer.text, address
            assert "root:x:" not in answer.text, address
            assert "set-cookie" not in answer.headers, address


@pytest.mark.parametrize("hostile", HOSTILE)
def test_hostile_words_in_forms_and_queries(site: WebSite, run_id: str, hostile: str) -> None:
    browser = site.browser("administrator")
    answers = [
        browser.post("/sign-in", data={"account": hostile, "password": hostile, "next": hostile}),
        browser.get("/sign-in", params={"next": hostile, "done": hostile}),
        browser.send_form("/accounts", account=hostile, full_name=hostile, role="auditor"),
        browser.send_form("/accounts/grace/role", role=hostile, reason=hostile),
        browser.send_form("/lock", back=hostile),
        browser.send_form("/unlock", back=hostile, pin=PIN),
        browser.get("/unlock", params={"back": hostile}),
    ]
    for answer in answers:
        must_be_shielded(answer)
        assert answer.status_code < 500
        assert "<script>alert" not in answer.text
        assert "<img src=x" not in answer.text
        assert not answer.headers.get("location", "/").startswith(("//", "http", "/\\"))


# --- errors --------------------------------------------------------------------------------------------------


def test_a_mistake_of_the_software_tells_a_reference_and_no_more(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def broken() -> None:
        raise ZeroDivisionError("inner secret of the software")

    with web_site(tmp_path) as site:
        site.app.add_api_route("/broken", broken)
        with caplog.at_level(logging.ERROR, logger="orthocapture.web"):
            page = site.browser().get("/broken")
            data = site.browser().get("/broken", headers={"accept": "application/json"})
    for answer in (page, data):
        must_be_shielded(answer)
        assert answer.status_code == 500
        assert "inner secret" not in answer.text
        assert "ZeroDivisionError" not in answer.text
    assert data.json()["reference"] in caplog.text
    assert "inner secret of the software" in caplog.text
    assert "safe" in page.text


def test_an_expected_error_says_what_where_what_to_do_and_that_the_data_is_safe(site: WebSite) -> None:
    browser = site.browser("technician")
    page = browser.get("/runs/nowhere")
    data = browser.get("/runs/nowhere", headers={"accept": "application/json"}).json()
    assert page.status_code == data["status"] == 404
    assert data["what"] == "there is no run 'nowhere'"
    assert "captured and recorded before is safe" in data["safe"]
    for words in ("There is no run", "safe", 'href="/"'):
        assert words in page.text


def test_a_refused_form_does_not_repeat_what_was_typed(site: WebSite, caplog: pytest.LogCaptureFixture) -> None:
    browser = site.browser("technician")
    secret = "typed secret " * 30
    answers = [
        browser.sign_in("grace", secret),
        browser.sign_in("grace", "another typed secret"),
        browser.send_form("/account/password", password=secret, new_password=secret, repeated=secret),
        browser.send_form("/account/pin", password="typed secret", pin="typed secret"),
        browser.post("/set-up/1", data={"password": secret, "repeated": secret, "pin": "typed secret"}),
    ]
    for answer in answers:
        assert 400 <= answer.status_code < 500
        assert "typed secret" not in answer.text
    assert "typed secret" not in caplog.text


# --- anything that the interface's own description allows, and what it does not --------------------------------


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory) -> list[Case[Any]]:
    """Requests to every operation, the same for each role; to draw them costs as much as to send them."""
    import schemathesis  # noqa: PLC0415 - a second, which every process would pay
    from schemathesis.core.result import Ok  # noqa: PLC0415

    with web_site(tmp_path_factory.mktemp("described")) as site:
        schema = schemathesis.openapi.from_dict(site.app.openapi())
    operations: list[APIOperation[Any, Any, Any, Any]] = [
        result.ok() for result in schema.get_all_operations() if isinstance(result, Ok)
    ]
    assert len(operations) > 40
    drawn: list[Case[Any]] = []
    for operation in operations:

        @seed(7)
        @settings(
            max_examples=3,
            deadline=None,
            database=None,
            phases=[Phase.generate],
            suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much, HealthCheck.data_too_large],
        )
        @given(case=operation.as_strategy())
        def one(case: Case[Any]) -> None:
            drawn.append(case)

        one()
    assert {case.path for case in drawn} == {operation.path for operation in operations}
    return drawn


ALWAYS: tuple[Role, ...] = ("administrator",)  # who may change most of a site


@pytest.mark.slow
@pytest.mark.parametrize(
    "role",
    [
        None,
        *ALWAYS,
        *(pytest.param(role, marks=pytest.mark.sweep) for role in ROLES if role not in ALWAYS),
    ],
)
def test_generated_requests_never_break_the_server(
    cases: list[Case[Any]], tmp_path_factory: pytest.TempPathFactory, role: Role | None
) -> None:
    from schemathesis.checks import not_a_server_error  # noqa: PLC0415

    with web_site(tmp_path_factory.mktemp("generated")) as site:
        run_id = site.begin_run().run_id
        for case in cases:
            if "run_id" in case.path_parameters and case.path not in ("/runs/{run_id}/stream",):
                case.path_parameters["run_id"] = run_id
            answer = _send(site, run_id, role, case)
            must_be_shielded(answer)
            case.validate_response(answer, checks=[not_a_server_error])


def _send(site: WebSite, run_id: str, role: Role | None, case: Case[Any]) -> httpx.Response:
    browser = _screen(site, run_id, role)
    sent = case.as_transport_kwargs(base_url=HOST)
    headers = {**(sent.get("headers") or {})}
    if role is not None:
        headers["x-csrf-token"] = browser.person.csrf
    return browser.request(
        sent["method"],
        sent["url"],
        params=sent.get("params"),
        headers=headers,
        data=sent.get("data"),
        json=sent.get("json"),
        follow_redirects=False,
    )


def _screen(site: WebSite, run_id: str, role: Role | None) -> Browser:
    """The last screen of the role; a new one if a request has locked it or signed it out."""
    for browser in reversed(site.browsers):
        if role is None:
            return browser
        person = site.people.person(browser.token, idle_lock_s=1e9, deliberate=False)
        if person is not None and not person.locked:
            return browser
    browser = site.browser(role)
    if role is not None and may(role, "operate"):
        site.take_control(run_id, browser)
    return browser
