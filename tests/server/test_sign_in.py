"""Signing in and out: cookie and token, invitations, failed tries, and a screen that locks when it is idle."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from service.store.records import SITE
from service.web.security import cookie_name
from tests.support.pages.web import PIN, WebSite, web_site
from tests.support.record.stepped_clock import SteppedClock


def test_the_cookie(site: WebSite) -> None:
    browser = site.browser()
    answer = browser.sign_in("grace")
    (cookie,) = answer.headers.get_list("set-cookie")
    parts = {part.strip().lower() for part in cookie.split(";")[1:]}
    assert cookie.startswith("__Host-orthocapture=")
    assert {"httponly", "secure", "samesite=strict", "path=/"} <= parts
    assert not any(part.startswith(("domain", "max-age", "expires")) for part in parts)


def test_a_sign_in_gets_a_new_token_and_ends_the_old(site: WebSite) -> None:
    browser, thief = site.browser(), site.browser()
    planted = "planted-by-somebody-else"
    browser.cookies.set(cookie_name(site.site), planted, domain="testserver.local", path="/")
    browser.sign_in("grace")
    first = browser.token
    assert first != planted
    assert len(first) >= 43
    browser.sign_in("grace")
    assert browser.token != first
    thief.cookies.set(cookie_name(site.site), first, domain="testserver.local", path="/")
    assert thief.get("/account", follow_redirects=False).status_code == 303


def test_signing_out_ends_it_on_the_server(site: WebSite) -> None:
    browser = site.browser("technician")
    token = browser.token
    assert browser.send_form("/sign-out").headers["location"].startswith("/sign-in")
    thief = site.browser()
    thief.cookies.set(cookie_name(site.site), token, domain="testserver.local", path="/")
    assert thief.get("/account", follow_redirects=False).status_code == 303


@pytest.mark.parametrize(
    "elsewhere",
    [
        "https://elsewhere.example/",
        "//elsewhere.example",
        "/\\elsewhere.example",
        "javascript:alert(1)",
        "/a\r\nb: c",
    ],
)
def test_nobody_is_sent_elsewhere_after_signing_in(site: WebSite, elsewhere: str) -> None:
    answer = site.browser().sign_in("grace", next=elsewhere)
    assert (answer.status_code, answer.headers["location"]) == (303, "/")
    assert elsewhere not in site.browser().get("/sign-in", params={"next": elsewhere}).text


def test_after_signing_in_the_page_that_was_asked_for(site: WebSite, run_id: str) -> None:
    browser = site.browser()
    asked = browser.get(f"/runs/{run_id}?step=capture", follow_redirects=False).headers["location"]
    page = browser.get(asked).text
    (following,) = re.findall(r'name="next" value="([^"]*)"', page)
    assert browser.sign_in("grace", next=following).headers["location"] == f"/runs/{run_id}?step=capture"


def test_an_invitation_is_shown_once_and_works_once(site: WebSite) -> None:
    administrator, newcomer = site.browser("administrator"), site.browser()
    page = administrator.send_form("/accounts", account="mary", full_name="Mary & Shelley", role="auditor")
    (link,) = re.findall(r">(https://testserver/set-up/[^<]+)<", page.text)
    assert "Mary &amp; Shelley" in page.text
    assert link.rsplit("/", 1)[1] not in administrator.get("/accounts/mary").text
    assert "Mary" in newcomer.get(link).text
    assert newcomer.get(link).status_code == 200  # a preview of the link does not use it up
    form = {"password": "a good password", "repeated": "a good password", "pin": PIN}
    different = newcomer.post(link, data=form | {"repeated": "another password"})
    assert different.status_code == 422
    assert newcomer.post(link, data=form, follow_redirects=False).status_code == 303
    assert newcomer.post(link, data=form, follow_redirects=False).status_code == 404
    assert newcomer.get(link).status_code == 404
    assert newcomer.sign_in("mary", "a good password").status_code == 303


def test_an_address_that_fails_too_often_is_not_listened_to(tmp_path: Path) -> None:
    clock = SteppedClock()
    with web_site(tmp_path, clock=clock) as site:
        browser = site.browser()
        for number in range(20):
            assert browser.sign_in(f"guess{number}", "wrong").status_code == 401
        refused = browser.sign_in("grace")
        assert refused.status_code == 429
        assert refused.headers["retry-after"] == "300"
        events = len(site.store.events(SITE))
        browser.sign_in("grace")
        assert len(site.store.events(SITE)) == events  # nor does it fill the record
        clock.passed_s += 300
        assert browser.sign_in("grace").status_code == 303


def test_a_restart_forgives_no_failed_try_and_counts_no_other(tmp_path: Path) -> None:
    clock = SteppedClock()
    with web_site(tmp_path, clock=clock) as site:
        browser = site.browser("technician")
        for number in range(18):
            assert browser.sign_in(f"guess{number}", "wrong").status_code == 401
        clock.passed_s = 100
        assert browser.sign_in("emmy", "wrong").status_code == 401
        browser = site.browser("technician")
        browser.send_form("/account/pin", password="wrong", pin="1111")  # a wrong password, but not a sign-in
        browser.send_form("/lock")
        browser.send_form("/unlock", pin="1111")
    clock.passed_s = 200
    with web_site(tmp_path, clock=clock) as site:
        browser = site.browser()
        assert browser.sign_in("guess", "wrong").status_code == 401  # the twentieth
        refused = browser.sign_in("emmy")
        assert (refused.status_code, refused.headers["retry-after"]) == (429, "100")
    with web_site(tmp_path, clock=clock) as site:
        assert site.browser().sign_in("emmy").status_code == 429  # the wait is recorded too, but not counted as a try
        clock.passed_s = 299
        assert site.browser().sign_in("emmy").status_code == 429
    clock.passed_s = 301
    with web_site(tmp_path, clock=clock) as site:
        assert site.browser().sign_in("emmy").status_code == 303


def test_an_idle_screen_locks_by_itself_and_parts_do_not_keep_it_open(tmp_path: Path) -> None:
    clock = SteppedClock()
    by_hand = {"sec-fetch-mode": "navigate", "sec-fetch-dest": "document"}
    with web_site(tmp_path, clock=clock, idle_lock_s=600) as site:
        browser = site.browser("technician")
        clock.passed_s = 599
        browser.get("/account", headers=by_hand)
        clock.passed_s += 599
        browser.get("/account", headers={"sec-fetch-mode": "cors", "sec-fetch-dest": "empty"})
        assert browser.send_form("/theme", theme="dark", back="/").status_code == 303  # a deliberate act
        clock.passed_s += 599
        browser.get("/account")
        clock.passed_s += 1
        page = browser.get("/account", headers=by_hand)
        assert page.status_code == 200  # the screen stays visible
        assert "data-locked" in page.text
        assert browser.send_form("/account/pin", password="x", pin="9999").status_code == 423
        wrong = browser.post("/unlock", data={"csrf": browser.person.csrf, "pin": "0000"})
        assert wrong.status_code == 403
        assert "4 tries are left" in wrong.text
        assert browser.send_form("/unlock", pin=PIN, back="/account").headers["location"] == "/account"
        assert "data-locked" not in browser.get("/account").text
