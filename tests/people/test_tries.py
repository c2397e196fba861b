"""Guessing slows down whoever guesses, and never shuts out a person whom the account knows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.core.records.events import AccountChanged, SignInRecorded
from service.people.credentials import FREE_FAILURES, SecretOrigin, on_screen_of
from service.people.person import Person, SignInRefusedError
from service.people.sessions import KnownBy, People
from service.store.records import SITE
from service.store.verification.verify import verify
from tests.support.pages.web import PIN, QUICK_HASHES, password_of, web_site
from tests.support.record.office import Office
from tests.support.record.outsider import outsider
from tests.support.record.stepped_clock import SteppedClock

HERE, ELSEWHERE = "10.0.0.7", "10.0.0.66"


def enter(office: Office, account: str, address: str) -> Person:
    token = office.people.sign_in(account, password_of(account), address=address)
    person = office.person(token)
    assert person is not None
    return person


def guess(office: Office, times: int, account: str = "emmy", address: str = ELSEWHERE) -> None:
    for _ in range(times):
        with pytest.raises(SignInRefusedError):
            office.people.sign_in(account, "guessed", address=address)


def slowed(office: Office, act: Callable[[], object]) -> bool:
    """Whether the right secret is refused now; a right one that is accepted changes nothing that is asked here."""
    try:
        act()
    except SignInRefusedError:
        return True
    return False


def test_strangers_shut_nobody_out_whom_the_account_knows(office: Office) -> None:
    emmy, grace = enter(office, "emmy", HERE), enter(office, "grace", HERE)
    for address in range(30):
        guess(office, 2, address=f"10.1.0.{address}")
    right = password_of("emmy")
    assert slowed(office, lambda: office.people.sign_in("emmy", right, address=ELSEWHERE))
    ways: list[tuple[KnownBy, str, SecretOrigin]] = [
        ("password", right, on_screen_of(emmy)),
        ("pin", PIN, on_screen_of(emmy)),
        ("password", right, on_screen_of(grace)),  # at the technician's screen
        ("password", right, SecretOrigin(address="terminal")),
    ]
    for known_by, secret, origin in ways:
        office.people.check_secret("emmy", known_by, secret, origin)
    office.people.sign_in("emmy", right, address=HERE)
    # And those sign-ins give strangers no further guesses.
    assert slowed(office, lambda: office.people.sign_in("emmy", right, address=ELSEWHERE))
    assert verify(office.data, SITE).ok


@pytest.mark.parametrize("where", ["address", "own screen", "another's screen", "terminal"])
def test_who_is_known_waits_for_wrong_secrets_given_there_and_nobody_else_does(office: Office, where: str) -> None:
    emmy, grace = enter(office, "emmy", HERE), enter(office, "grace", "10.0.0.8")
    right = password_of("emmy")
    acts: dict[str, Callable[[str], object]] = {
        "address": lambda secret: office.people.sign_in("emmy", secret, address=HERE),
        "own screen": lambda secret: office.people.check_password("emmy", secret, on_screen_of(emmy)),
        "another's screen": lambda secret: office.people.check_password("emmy", secret, on_screen_of(grace)),
        "terminal": lambda secret: office.people.check_password("emmy", secret),
    }
    waits: list[float] = []
    for _ in range(FREE_FAILURES - 1):
        assert slowed(office, lambda: acts[where]("guessed"))
    for _ in range(7):
        assert slowed(office, lambda: acts[where]("guessed"))
        assert slowed(office, lambda: acts[where](right))
        until = office.people.accounts.waits_until_utc_s(office.people.accounts.get("emmy"))
        waits.append(round(until - office.clock.utc_s(), 3))
        office.clock.passed_s += waits[-1]
    assert waits == [30, 60, 120, 240, 480, 900, 900]
    assert slowed(office, lambda: acts[where]("guessed"))
    for other in acts.keys() - {where}:
        acts[other](right)
    office.people.sign_in("emmy", right, address="10.0.0.99")
    office.clock.passed_s += 900
    acts[where](right)
    guess(office, FREE_FAILURES - 1, address=HERE)
    acts[where](right)  # the count began anew


def test_who_guesses_anothers_secret_does_not_begin_anew_by_signing_in_again(office: Office) -> None:
    for _ in range(FREE_FAILURES):
        grace = enter(office, "grace", HERE)
        with pytest.raises(SignInRefusedError):
            office.people.check_secret("emmy", "pin", "9999", on_screen_of(grace))
    grace = enter(office, "grace", ELSEWHERE)
    assert slowed(office, lambda: office.people.check_secret("emmy", "pin", PIN, on_screen_of(grace)))
    assert slowed(office, lambda: office.people.check_password("emmy", password_of("emmy"), on_screen_of(grace)))
    office.people.check_password("grace", password_of("grace"), on_screen_of(grace))
    by_grace = [event.payload for event in office.store.events(SITE) if event.actor == "grace"]
    last = by_grace[-1]
    assert isinstance(last, SignInRecorded)
    assert (last.account, last.outcome) == ("emmy", "locked_out")


def test_another_process_and_a_restart_count_on(office: Office) -> None:
    emmy = enter(office, "emmy", HERE)
    guess(office, FREE_FAILURES, address=HERE)
    for _ in range(FREE_FAILURES):
        with pytest.raises(SignInRefusedError):
            office.people.check_password("emmy", "guessed", on_screen_of(emmy))
    office.clock.passed_s += 29.0
    again = People(office.store, QUICK_HASHES)
    for act in (
        lambda: again.sign_in("emmy", password_of("emmy"), address=HERE),
        lambda: again.check_password("emmy", password_of("emmy"), on_screen_of(emmy)),
    ):
        assert slowed(office, act)
    again.check_password("emmy", password_of("emmy"))
    office.clock.passed_s += 1.0
    again.sign_in("emmy", password_of("emmy"), address=HERE)
    guess(office, FREE_FAILURES - 1, address=HERE)
    People(office.store, QUICK_HASHES).sign_in("emmy", password_of("emmy"), address=HERE)


def test_every_refusal_is_an_event_that_says_where(office: Office) -> None:
    grace = enter(office, "grace", HERE)
    before = len(office.store.events(SITE))
    guess(office, FREE_FAILURES + 1)
    for _ in range(FREE_FAILURES + 1):
        with pytest.raises(SignInRefusedError):
            office.people.check_password("emmy", "guessed", on_screen_of(grace))
    told = [
        (event.actor, event.payload.outcome, event.payload.address, event.payload.screen)
        for event in office.store.events(SITE)[before:]
        if isinstance(event.payload, SignInRecorded)
    ]
    assert told == [
        *[("web", "refused", ELSEWHERE, "")] * (FREE_FAILURES - 1),
        *[("web", "locked_out", ELSEWHERE, "")] * 2,
        *[("grace", "refused", "", grace.screen)] * FREE_FAILURES,
        ("grace", "locked_out", "", grace.screen),
    ]
    assert verify(office.data, SITE).ok


@pytest.mark.sqlite("backups and journal: a server has its own")
def test_the_journal_shows_a_wait_that_was_ended_past_the_software(office: Office) -> None:
    guess(office, FREE_FAILURES)
    assert verify(office.data, SITE).ok
    with outsider(office.data) as connection:
        connection.execute("UPDATE accounts SET failures = 0, locked_until_utc_s = 0")
    assert any("accounts is not as it is in the journal" in fault.what for fault in verify(office.data, SITE).faults)


# --- an administrator clears it ---


def test_an_administrator_clears_every_wait_on_the_page(tmp_path: Path) -> None:
    with web_site(tmp_path, clock=SteppedClock()) as site:
        emmy, administrator = site.browser("supervisor"), site.browser("administrator")
        for _ in range(FREE_FAILURES):
            assert site.browser().sign_in("emmy", "guessed").status_code == 401
            emmy.send_form("/account/pin", password="guessed", pin="1111")
        assert emmy.send_form("/account/pin", password=password_of("emmy"), pin="1111").status_code == 401
        assert "End the wait" in administrator.get("/accounts/emmy").text
        assert "Waits after wrong passwords" in administrator.get("/accounts").text
        site.store.clock.passed_s += 1.0  # type: ignore[attr-defined] # a SteppedClock
        assert administrator.send_form("/accounts/emmy/end-wait").status_code == 303
        assert "End the wait" not in administrator.get("/accounts/emmy").text
        assert emmy.send_form("/account/pin", password=password_of("emmy"), pin="1111").status_code == 303
        assert site.browser().sign_in("emmy").status_code == 303


@pytest.mark.slow
def test_an_administrator_clears_it_on_the_command_line(tmp_path: Path) -> None:
    with web_site(tmp_path) as site:
        emmy, data = site.browser("supervisor"), ["--data", str(site.site.data), "--password-stdin"]
        for _ in range(FREE_FAILURES):
            assert site.browser().sign_in("emmy", "guessed").status_code == 401
            emmy.send_form("/account/pin", password="guessed", pin="1111")
        words = ["accounts", "end-wait", "emmy", *data, "--operator"]
        for name, said in (("emmy", "emmy is supervisor and may not do this"), ("eve", "only accounts act")):
            refused = CliRunner().invoke(app, [*words, name], input=f"{password_of(name)}\n", catch_exceptions=False)
            assert (refused.exit_code, said in refused.stderr) == (1, True), refused.stderr
        done = CliRunner().invoke(app, [*words, "ada"], input=f"{password_of('ada')}\n", catch_exceptions=False)
        assert done.exit_code == 0, done.stderr
        assert emmy.send_form("/account/pin", password=password_of("emmy"), pin="1111").status_code == 303
        assert site.browser().sign_in("emmy").status_code == 303
        (ended,) = [e for e in site.store.events(SITE) if getattr(e.payload, "field", "") == "lock_out"]
        assert ended.actor == "ada"
        assert isinstance(ended.payload, AccountChanged)
        assert verify(site.site.data, SITE).ok


# --- addresses ---


def test_an_address_that_fails_too_often_still_lets_in_who_signed_in_from_there(tmp_path: Path) -> None:
    with web_site(tmp_path, clock=SteppedClock()) as site:
        site.browser("technician")  # grace has signed in from this address; emmy has not
        for number in range(20):
            assert site.browser().sign_in(f"guess{number}", "wrong").status_code == 401
        assert site.browser().sign_in("emmy").status_code == 429
        assert site.browser().sign_in("grace").status_code == 303
        for _ in range(FREE_FAILURES):
            assert site.browser().sign_in("grace", "wrong").status_code == 401
        count = len(site.store.events(SITE))
        assert site.browser().sign_in("grace", "wrong").status_code == 429
        assert len(site.store.events(SITE)) == count  # nor can it fill the record through her name
        site.store.clock.passed_s += 30.0  # type: ignore[attr-defined] # a SteppedClock
        site.people.accounts.disable(site.browser("administrator").person, "grace", "left the house")
        answers = [site.browser().sign_in("grace", "wrong").status_code for _ in range(FREE_FAILURES + 1)]
        assert answers[-1] == 429  # nor through the name of somebody who has left
