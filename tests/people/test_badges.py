"""PIN and badge instead of a password: only where the site allows it; hashed, limited, revocable, recorded."""

from __future__ import annotations

import re
from collections.abc import Generator
from pathlib import Path

import pytest

from service.core.records.events import AccountChanged
from service.core.records.run_events import OperatorAction
from service.people.credentials import FREE_FAILURES
from service.people.person import AccountError, Role, SignInRefusedError
from service.people.sessions import KnownBy
from service.rig import load_rig
from service.store.records import SITE
from service.store.verification.verify import verify
from tests.support.pages.at_the_table import left_at
from tests.support.pages.web import PIN, Browser, WebSite, password_of, web_site
from tests.support.processes.waiting import until
from tests.support.record.outsider import outsider
from tests.support.runs.bench_run import PROTOCOL, Bench

BADGE = "0004711815"
EMMYS_BADGE = "04a1b2c3d4e5f6"
ACCEPTING = PROTOCOL.replace("viewpoints_captured, min: 3", "viewpoints_captured, min: 5, accept_by: supervisor")


@pytest.fixture
def web(tmp_path: Path) -> Generator[WebSite]:
    with web_site(tmp_path) as site:
        yield site


def allow(web: WebSite, signing: str) -> None:
    """Write the rig file of a site that accepts more than passwords."""
    rig = web.folder / "rig.yaml"
    rig.write_text(f"{rig.read_text()}signing: {signing}\n")
    web.site.rig = load_rig(rig)


def waiting(web: WebSite, step: str, question: str, protocol: str = PROTOCOL) -> tuple[Bench, Browser]:
    """A run that waits for a person, controlled by the technician's screen."""
    bench = left_at(web, step, question, protocol)
    browser = web.browser("technician")
    web.take_control(bench.run_id, browser)
    return bench, browser


def act(bench: Bench, browser: Browser, verb: str, known_by: str, secret: str, **fields: str) -> int:
    page = browser.get(f"/runs/{bench.run_id}", params={"dialog": verb}).text
    found = re.search(r'name="signed_sha256" value="(\w+)"', page)
    assert found is not None
    return browser.send_form(
        f"/runs/{bench.run_id}/actions",
        verb=verb,
        step=bench.state().current,
        attempt=1,
        seen_seq=bench.state().seq,
        signed_sha256=found[1],
        meaning="I have checked it",
        known_by=known_by,
        password=secret,
        **fields,
    ).status_code


def enrol(web: WebSite, account: str, badge: str, by: Role = "supervisor", password: str | None = None) -> int:
    given = {"password": password_of(account) if password is None else password, "badge": badge}
    return web.browser(by).send_form(f"/badges/{account}", **given).status_code


def signatures(bench: Bench) -> list[tuple[str, str]]:
    return [
        (event.actor, event.payload.identified)
        for event in bench.store.events(bench.run_id)
        if isinstance(event.payload, OperatorAction) and event.payload.action == "sign"
    ]


@pytest.mark.parametrize(
    ("signing", "known_by", "secret"),
    [("{}", "password", password_of("grace")), ("{pin: true}", "pin", PIN), ("{badge: true}", "badge", BADGE)],
)
def test_a_step_is_signed_by_what_the_site_allows_and_the_record_says_how(
    web: WebSite, signing: str, known_by: str, secret: str
) -> None:
    allow(web, signing)
    assert enrol(web, "grace", BADGE) == 303
    bench, browser = waiting(web, "spraying", "sign")
    page = browser.get(f"/runs/{bench.run_id}").text
    assert ('value="pin"' in page, 'value="badge"' in page) == ("pin" in signing, "badge" in signing)
    assert act(bench, browser, "sign", known_by, secret) == 303
    assert signatures(bench) == [("grace", known_by)]
    bench.must_verify()
    auditor, said = (
        web.browser("auditor"),
        {"password": "by password", "pin": "by PIN", "badge": "by badge"}[known_by],
    )
    until(lambda: said in auditor.get(f"/audit/runs/{bench.run_id}/signatures").text, "the signatures are computed")


@pytest.mark.parametrize(("known_by", "secret"), [("pin", PIN), ("badge", BADGE)])
def test_where_the_site_does_not_allow_it_the_right_one_signs_nothing(
    web: WebSite, known_by: str, secret: str
) -> None:
    assert enrol(web, "grace", BADGE) == 303
    bench, browser = waiting(web, "spraying", "sign")
    assert act(bench, browser, "sign", known_by, secret) == 403
    accepting, screen = waiting(web, "capture", "recovery", ACCEPTING)
    assert act(accepting, screen, "accept", known_by, PIN, account="emmy", reason="enough") == 403
    assert signatures(bench) == []
    assert accepting.state().steps["capture"].accepted is None


def test_a_supervisor_accepts_by_badge_on_the_technicians_screen(web: WebSite) -> None:
    allow(web, "{badge: true}")
    assert enrol(web, "emmy", EMMYS_BADGE, by="administrator") == 303
    assert enrol(web, "grace", BADGE) == 303
    bench, browser = waiting(web, "capture", "recovery", ACCEPTING)
    given = {"account": "emmy", "reason": "enough"}
    page = browser.get(f"/runs/{bench.run_id}").text
    assert re.findall(r'<option value="(\w+)">Emmy Noether', page) == ["emmy"], "the name is offered"
    assert act(bench, browser, "accept", "badge", BADGE, **given) == 401, "the technician's own does not do"
    assert act(bench, browser, "accept", "badge", EMMYS_BADGE, **given) == 303
    accepted = bench.state().steps["capture"].accepted
    assert accepted is not None
    assert (accepted.by, accepted.identified) == ("emmy", "badge")
    page = web.browser("auditor").get(f"/runs/{bench.run_id}", params={"step": "capture"}).text
    assert "accepted by emmy (supervisor, by badge)" in page


@pytest.mark.parametrize("known_by", ["pin", "badge"])
def test_wrong_ones_count_as_wrong_passwords_do(web: WebSite, known_by: KnownBy) -> None:
    right = {"pin": PIN, "badge": BADGE}[known_by]
    assert enrol(web, "grace", BADGE) == 303
    web.people.check_secret("grace", known_by, right)
    for _ in range(FREE_FAILURES):
        with pytest.raises(SignInRefusedError):
            web.people.check_secret("grace", known_by, "999999")
    for way, secret in ((known_by, right), ("password", password_of("grace"))):
        with pytest.raises(SignInRefusedError, match="has to wait"):
            web.people.check_secret("grace", way, secret)  # type: ignore[arg-type] # one of the three


def test_the_right_pin_gains_nobody_further_guesses_at_the_password(web: WebSite) -> None:
    for _ in range(FREE_FAILURES - 1):
        with pytest.raises(SignInRefusedError):
            web.people.check_password("grace", "guessed it")
    web.people.check_secret("grace", "pin", PIN)
    for secret in ("guessed it", password_of("grace")):
        with pytest.raises(SignInRefusedError):
            web.people.check_password("grace", secret)


def test_a_badge_is_stored_hashed_and_told_without_itself(web: WebSite) -> None:
    assert enrol(web, "grace", BADGE) == 303
    with outsider(web.site.data) as connection:
        (stored,) = connection.execute("SELECT badge_hash FROM accounts WHERE account = 'grace'").fetchone()
    assert re.fullmatch(r"hmac-sha256:[0-9a-f]{16}:\$argon2id\$.*", stored)
    told = [e for e in web.store.events(SITE) if isinstance(e.payload, AccountChanged) and e.payload.field == "badge"]
    assert [(e.actor, e.payload.account, e.payload.new) for e in told] == [("emmy", "grace", "enrolled")]  # type: ignore[union-attr]
    for file in web.site.data.rglob("*"):
        assert not file.is_file() or BADGE.encode() not in file.read_bytes(), file
    assert verify(web.site.data).ok


def test_a_badge_put_in_past_the_software_shows(web: WebSite) -> None:
    assert enrol(web, "grace", BADGE) == 303
    web.store.close()
    with outsider(web.site.data) as connection:
        connection.execute(
            "UPDATE accounts SET badge_hash = (SELECT badge_hash FROM accounts WHERE account = 'grace')"
        )
    said = "\n".join(str(fault) for fault in verify(web.site.data).faults)
    assert "the badge of the account emmy was set past the software" in said
    assert "the badge of the account grace" not in said


def test_only_supervisors_and_administrators_enrol_and_the_owner_agrees(web: WebSite) -> None:
    assert enrol(web, "grace", BADGE, by="technician") == 403
    assert enrol(web, "grace", BADGE, by="auditor") == 403
    assert enrol(web, "grace", BADGE, password="not hers") == 401
    assert enrol(web, "grace", "12345") == 422
    assert not web.people.accounts.get("grace").badge
    assert enrol(web, "grace", BADGE, by="administrator") == 303
    assert enrol(web, "emmy", BADGE) == 422, "one badge for two people"
    with pytest.raises(SignInRefusedError):
        web.people.check_secret("emmy", "badge", BADGE)


def test_a_revoked_badge_signs_nothing(web: WebSite) -> None:
    assert enrol(web, "grace", BADGE) == 303
    assert web.browser("supervisor").send_form("/badges/grace/revoke", reason="found on the floor").status_code == 303
    with pytest.raises(SignInRefusedError):
        web.people.check_secret("grace", "badge", BADGE)
    assert enrol(web, "grace", BADGE) == 303
    assert web.browser("technician").send_form("/account/badge/revoke").status_code == 303  # her own, lost
    with pytest.raises(SignInRefusedError):
        web.people.check_secret("grace", "badge", BADGE)
    with pytest.raises(AccountError, match="has no badge"):
        web.people.badges.revoke(web.browser("technician").person, "grace", "once more")
    assert enrol(web, "grace", BADGE) == 303
    assert web.browser("administrator").send_form("/accounts/grace/reset", reason="left the house").status_code == 200
    assert not web.people.accounts.get("grace").badge
    assert verify(web.site.data).ok
