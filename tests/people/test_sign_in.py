"""Sign-ins: who gets in, who must wait, and when a screen locks."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from argon2 import PasswordHasher
from argon2.low_level import Type
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy import Connection

from service.core.records.events import ServiceStarted, SignInRecorded
from service.people.credentials import failed_tries, wait_after_s
from service.people.person import NotSignedInError, PinRefusedError
from service.people.sessions import People
from service.store.database.database import Database
from tests.support.pages.web import PIN, password_of
from tests.support.record.office import IDLE_S, Office, refused
from tests.support.record.outsider import outsider


def test_sign_in_and_out(office: Office) -> None:
    token, person = office.enter("Grace")
    assert (person.account, person.role, person.locked) == ("grace", "technician", False)
    assert person.csrf not in repr(person)
    office.people.sign_out(person)
    assert office.person(token) is None
    assert office.outcomes("grace")[-2:] == ["signed_in", "signed_out"]


def test_every_sign_in_has_its_own_tokens(office: Office) -> None:
    (one, first), (two, second) = office.enter("grace"), office.enter("grace")
    assert len({one, two, first.csrf, second.csrf}) == 4
    assert first.screen != second.screen
    third = office.people.sign_in("grace", password_of("grace"), replaces=one)
    assert office.person(one) is None
    assert office.person(two) is not None
    assert office.person(third) is not None


def test_a_sign_in_ends_after_twelve_hours_however_busy(office: Office) -> None:
    token, _ = office.enter("grace")
    for hour in range(1, 72):
        office.clock.passed_s = 600 * hour - 1
        assert office.person(token, deliberate=True) is not None
    office.clock.passed_s = 12 * 3600
    assert office.person(token, deliberate=True) is None
    assert office.outcomes("grace")[-1] == "ended"


def test_a_sign_in_lives_no_longer_because_the_clock_was_set_back(office: Office) -> None:
    token, _ = office.enter("grace")
    office.clock.passed_s = 6 * 3600.0
    office.clock.set_utc(-3600.0)
    office.clock.passed_s = 12 * 3600.0 - 1
    assert office.person(token) is not None
    office.clock.passed_s = 12 * 3600.0
    assert office.person(token) is None


def test_sign_ins_that_nobody_came_back_to_end_in_the_record_too(office: Office) -> None:
    office.enter("grace")
    office.clock.passed_s = 12 * 3600
    office.enter("emmy")
    assert office.people.screens("grace") == []
    assert office.outcomes("grace") == ["signed_in", "ended"]


def test_refusals_are_the_same_words_whatever_the_cause(office: Office) -> None:
    _, administrator = office.enter("ada")
    office.people.accounts.disable(administrator, "lise", "left the house")
    causes = [
        refused(lambda: office.people.sign_in("grace", "wrong")),
        refused(lambda: office.people.sign_in("nobody", "wrong")),
        refused(lambda: office.people.sign_in("lise", password_of("lise"))),
        refused(lambda: office.people.sign_in("", "")),
    ]
    for _ in range(6):
        causes.append(refused(lambda: office.people.sign_in("emmy", "wrong")))
    causes.append(refused(lambda: office.people.sign_in("emmy", password_of("emmy"))))
    assert len({str(error) for error in causes}) == 1


def test_a_password_is_hashed_for_every_refusal(office: Office, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once, whether it is compared with a stored hash or there is none."""
    hashed: list[str] = []
    verify, make = PasswordHasher.verify, PasswordHasher.hash

    def verify_and_count(self: PasswordHasher, stored: str, given: str) -> bool:
        hashed.append(given)
        return bool(verify(self, stored, given))

    def make_and_count(self: PasswordHasher, given: str) -> str:
        hashed.append(given)
        return make(self, given)

    monkeypatch.setattr(PasswordHasher, "verify", verify_and_count)
    monkeypatch.setattr(PasswordHasher, "hash", make_and_count)
    for account in ("grace", "nobody", "grace", "grace", "grace", "grace", "grace"):  # waits at the end
        refused(lambda account=account: office.people.sign_in(account, "wrong"))
    assert hashed == ["wrong"] * 7


def test_wrong_passwords_lock_out_with_growing_waits(office: Office) -> None:
    waits: list[float] = []
    for _ in range(4):
        refused(lambda: office.people.sign_in("grace", "wrong"))
    for _ in range(7):
        refused(lambda: office.people.sign_in("grace", "wrong"))
        now = office.clock.utc_s()
        until = office.people.accounts.get("grace").locked_until_utc_s
        waits.append(round(until - now, 3))
        refused(lambda: office.people.sign_in("grace", password_of("grace")))  # even with the right one
        office.clock.passed_s += until - now
    assert waits == [30, 60, 120, 240, 480, 900, 900]
    office.enter("grace")
    account = office.people.accounts.get("grace")
    assert (account.failures, account.locked_until_utc_s) == (0, 0)
    assert office.outcomes("grace").count("locked_out") == 14
    assert office.outcomes("grace").count("refused") == 4


@given(st.integers(0, 10**6))
def test_waits_never_shrink_and_never_pass_a_quarter_of_an_hour(failures: int) -> None:
    assert 0 <= wait_after_s(failures) <= wait_after_s(failures + 1) <= 900
    assert (wait_after_s(failures) == 0) == (failures < 5)


def test_a_wrong_password_of_a_signature_counts(office: Office) -> None:
    office.people.check_password("grace", password_of("grace"))
    for _ in range(5):
        refused(lambda: office.people.check_password("grace", "wrong"))
    refused(lambda: office.people.check_password("grace", password_of("grace")))
    office.clock.passed_s += 30
    office.people.check_password("grace", password_of("grace"))
    assert office.people.accounts.get("grace").failures == 0


def test_a_restart_remembers_who_guessed_from_where(office: Office) -> None:
    """Only a guess at a password from a known address counts, for as long as the window says."""
    for outcome, account, address in (
        ("refused", "grace", "10.0.0.1"),
        ("refused", "", "10.0.0.2"),  # an account that does not exist
        ("locked_out", "grace", "10.0.0.3"),  # a guess at an account that has to wait
        ("locked_out", "", "10.0.0.4"),  # an address that has to wait: nothing was tried
        ("refused", "grace", ""),  # a PIN or a signature at a screen that is signed in
        ("locked_out", "grace", ""),
        ("signed_in", "grace", "10.0.0.5"),
        ("signed_out", "grace", "10.0.0.6"),
        ("ended", "grace", "10.0.0.7"),
        ("screen_locked", "grace", "10.0.0.8"),
    ):
        tried = SignInRecorded.model_validate({"outcome": outcome, "account": account, "address": address})
        office.store.record_site([tried], actor="service")
    office.clock.passed_s += 50.0
    tries = failed_tries(office.store, 60.0)
    assert [address for address, _ in tries] == ["10.0.0.1", "10.0.0.2", "10.0.0.3"]
    assert [age_s for _, age_s in tries] == pytest.approx([50.0] * 3, abs=1.0)
    assert failed_tries(office.store, 40.0) == []


def test_a_restart_after_the_clock_was_set_forward_forgets_no_guess(office: Office) -> None:
    nothing = {"software": {}, "configuration": {}, "changed": {}, "heads": {}, "clock_jump_s": None}
    more = {"unsigned_runs": (), "open_runs": (), "host": "here", "pid": 1, "address": "x"}
    started = ServiceStarted.model_validate({"boot": office.clock.boot(), **nothing, **more})
    tried = SignInRecorded(account="grace", outcome="refused", address="10.0.0.1")
    office.store.record_site([started, tried], actor="service")
    office.clock.set_utc(3600.0)
    office.clock.passed_s += 50.0
    office.store.record_site([started], actor="service")
    ((address, age_s),) = failed_tries(office.store, 60.0)
    assert (address, age_s) == ("10.0.0.1", pytest.approx(50.0))
    office.clock.passed_s += 20.0
    assert failed_tries(office.store, 60.0) == []
    office.clock.reboot(600.0)  # the monotonic time of another boot tells nothing
    office.store.record_site([started.model_copy(update={"boot": office.clock.boot()})], actor="service")
    assert failed_tries(office.store, 60.0) == []


def test_hashes_follow_the_parameters_of_today(office: Office, tmp_path: Path) -> None:
    assert PasswordHasher().type is Type.ID
    stronger = People(office.store, PasswordHasher(time_cost=2, memory_cost=16, parallelism=1))
    refused(lambda: stronger.sign_in("grace", "a wrong password"))
    stronger.sign_in("grace", password_of("grace"))
    with outsider(office.data) as connection:
        stored = dict(connection.execute("SELECT account, password_hash FROM accounts"))
        assert connection.execute("SELECT failures FROM accounts WHERE account = 'grace'").fetchone() == (0,)
    assert "m=16,t=2" in stored["grace"]
    assert "m=8,t=1" in stored["emmy"]
    office.enter("grace")  # and the old process still accepts it


def test_an_idle_screen_locks_and_its_pin_opens_it(office: Office) -> None:
    token, _ = office.enter("grace")
    office.clock.passed_s = IDLE_S - 1
    open_still = office.person(token, deliberate=True)
    assert open_still
    assert not open_still.locked
    office.clock.passed_s += IDLE_S - 1
    by_itself = office.person(token)  # the page reloads its parts, which does not count as activity
    assert by_itself
    assert not by_itself.locked
    office.clock.passed_s += 1
    locked = office.person(token, deliberate=True)
    assert locked
    assert locked.locked
    with pytest.raises(PinRefusedError):
        office.people.unlock(locked, "0000")
    office.people.unlock(locked, PIN)
    opened = office.person(token)
    assert opened
    assert not opened.locked
    assert office.outcomes("grace")[-3:] == ["screen_locked", "refused", "screen_unlocked"]


def test_a_screen_that_is_signed_out_while_it_locks_is_nobodys(
    office: Office, monkeypatch: pytest.MonkeyPatch
) -> None:
    token, person = office.enter("grace")
    office.clock.passed_s = IDLE_S
    database = type(office.store.database)
    writing = database.writing

    def after_a_sign_out(self: Database) -> AbstractContextManager[Connection]:
        monkeypatch.undo()
        office.people.sign_out(person)
        return writing(self)

    monkeypatch.setattr(database, "writing", after_a_sign_out)
    assert office.person(token, deliberate=True) is None


def test_a_screen_locks_when_its_idle_time_is_not_known_since_the_clock_was_set_back(office: Office) -> None:
    token, _ = office.enter("grace")
    office.clock.set_utc(-4.0)  # as much as a time server corrects now and then
    steady = office.person(token, deliberate=True)
    assert steady
    assert not steady.locked
    office.clock.set_utc(-3600.0)
    locked = office.person(token, deliberate=True)
    assert locked
    assert locked.locked
    office.people.unlock(locked, PIN)
    office.clock.passed_s += 1
    opened = office.person(token, deliberate=True)
    assert opened
    assert not opened.locked


def test_a_clock_that_is_set_back_makes_no_account_wait_longer_than_the_longest(office: Office) -> None:
    for _ in range(5):
        refused(lambda: office.people.sign_in("grace", "wrong"))
    office.clock.set_utc(-3600.0)
    refused(lambda: office.people.sign_in("grace", password_of("grace")))
    office.clock.passed_s += 900
    office.enter("grace")


def test_a_clock_that_is_set_forward_ends_no_wait(office: Office) -> None:
    for _ in range(5):
        refused(lambda: office.people.sign_in("grace", "wrong"))
    office.clock.set_utc(3600.0)
    refused(lambda: office.people.sign_in("grace", password_of("grace")))
    assert office.people.accounts.strangers_wait(office.people.accounts.get("grace"))
    office.clock.passed_s += 31
    office.enter("grace")


def test_five_wrong_pins_end_the_sign_in(office: Office) -> None:
    token, person = office.enter("grace")
    office.people.lock(person)
    for _ in range(4):
        with pytest.raises(PinRefusedError):
            office.people.unlock(person, "0000")
    with pytest.raises(NotSignedInError):
        office.people.unlock(person, "0000")
    assert office.person(token) is None
    with pytest.raises(NotSignedInError):
        office.people.unlock(person, PIN)
