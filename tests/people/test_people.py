"""Accounts and sign-ins: who gets in, who must wait, what is recorded, and that secrets never are."""

from __future__ import annotations

import re
import sqlite3
import unicodedata
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pytest
from argon2 import PasswordHasher
from argon2.low_level import Type
from hypothesis import given
from hypothesis import strategies as st

from service.core.records.events import AccountChanged, SignInRecorded
from service.people.errors import (
    AccountError,
    LinkError,
    NotSignedInError,
    PeopleError,
    PinRefusedError,
    SignInRefusedError,
)
from service.people.person import Person
from service.people.roles import ROLES, may
from service.people.sessions import People, wait_after_s
from service.store.database.engine import database_path
from service.store.records import SITE
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.web import PIN, QUICK_HASHES, password_of, populate
from tests.support.record.store import CrashingFiles, SteppedClock

IDLE_S = 600.0


@dataclass
class Office:
    """People with a clock that stands still unless told otherwise."""

    people: People
    store: Store
    clock: SteppedClock
    data: Path

    def person(self, token: str, *, deliberate: bool = False) -> Person | None:
        return self.people.person(token, idle_lock_s=IDLE_S, deliberate=deliberate)

    def enter(self, account: str) -> tuple[str, Person]:
        token = self.people.sign_in(account, password_of(account))
        person = self.person(token)
        assert person is not None
        return token, person

    def outcomes(self, account: str | None = None) -> list[str]:
        """Recorded outcomes of sign-ins since the office was created."""
        events = [event.payload for event in self.store.events(SITE)]
        signs = [p for p in events if isinstance(p, SignInRecorded) and account in (None, p.account)]
        return [p.outcome for p in signs]

    def changes(self, account: str) -> list[tuple[str, str, str, str]]:
        events = [event.payload for event in self.store.events(SITE)]
        own = [p for p in events if isinstance(p, AccountChanged) and p.account == account]
        return [(p.field, p.old, p.new, p.reason) for p in own]


@pytest.fixture
def office(tmp_path: Path) -> Generator[Office]:
    clock = SteppedClock()
    with Store.open(tmp_path / "data", clock) as store:
        people = People(store, QUICK_HASHES)
        populate(people)
        yield Office(people, store, clock, tmp_path / "data")


def refused(act: Callable[[], object]) -> PeopleError:
    with pytest.raises(PeopleError) as caught:
        act()
    return caught.value


# --- first set-up and invitations ----------------------------------------------------------------------------


def test_first_link_makes_the_administrator_once(tmp_path: Path) -> None:
    with Store.open(tmp_path, SteppedClock()) as store:
        people = People(store, QUICK_HASHES)
        old, link = people.first_link(), people.first_link()
        assert old
        assert link
        with pytest.raises(LinkError):  # a newer link invalidates it
            people.accounts.set_up(old, "ada", "Ada Lovelace", "a good password", PIN)
        assert people.accounts.set_up(link, " Ada ", "Ada  Lovelace", "a good password", PIN) == "ada"
        assert people.first_link() is None
        with pytest.raises(LinkError):
            people.accounts.set_up(link, "eve", "Eve", "a good password", PIN)
        (account,) = people.accounts.all()
        assert (account.account, account.full_name, account.role) == ("ada", "Ada Lovelace", "administrator")


def test_first_link_expires_after_a_day(tmp_path: Path) -> None:
    clock = SteppedClock()
    with Store.open(tmp_path, clock) as store:
        people = People(store, QUICK_HASHES)
        link = people.first_link()
        assert link
        clock.passed_s = 24 * 3600
        with pytest.raises(LinkError):
            people.accounts.set_up(link, "ada", "Ada Lovelace", "a good password", PIN)


@pytest.mark.parametrize(
    ("password", "pin", "word"),
    [
        ("short", PIN, "password"),
        ("a" * 300, PIN, "password"),
        ("mary.shelley", PIN, "password"),
        ("a good password", "12", "PIN"),
        ("a good password", "12ab", "PIN"),
        ("a good password", "١٢٣٤", "PIN"),
        ("a good password", "123456789", "PIN"),
    ],
)
def test_weak_secrets_are_refused_and_the_link_stays_good(office: Office, password: str, pin: str, word: str) -> None:
    _, administrator = office.enter("ada")
    link = office.people.accounts.invite(administrator, "mary.shelley", "Mary Shelley", "auditor")
    with pytest.raises(AccountError, match=word):
        office.people.accounts.accept(link, password, pin)
    assert office.people.accounts.accept(link, "a good password", PIN) == "mary.shelley"
    with pytest.raises(LinkError):
        office.people.accounts.accept(link, "another password", PIN)


@pytest.mark.parametrize("name", ["", "x", "runner", "web", "9lives", "a b", "é" * 4, "a/../b", "x" * 40, "a\u0000b"])
def test_names_that_cannot_be_accounts(office: Office, name: str) -> None:
    _, administrator = office.enter("ada")
    with pytest.raises(AccountError):
        office.people.accounts.invite(administrator, name, "Some Body", "auditor")


def test_names_differ_by_more_than_case(office: Office) -> None:
    _, administrator = office.enter("ada")
    with pytest.raises(AccountError, match="already"):
        office.people.accounts.invite(administrator, "GRACE", "Another Grace", "auditor")


def test_invited_people_cannot_sign_in_before_they_have_a_password(office: Office) -> None:
    _, administrator = office.enter("ada")
    office.people.accounts.invite(administrator, "mary", "Mary Shelley", "auditor")
    for password in ("", "x", password_of("mary")):
        with pytest.raises(SignInRefusedError):
            office.people.sign_in("mary", password)


# --- signing in ----------------------------------------------------------------------------------------------


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
    hashed: list[str] = []
    real = PasswordHasher.verify

    def verify_and_count(self: PasswordHasher, stored: str, given: str) -> bool:
        hashed.append(given)
        return bool(real(self, stored, given))

    monkeypatch.setattr(PasswordHasher, "verify", verify_and_count)
    for account in ("grace", "nobody", "grace", "grace", "grace", "grace", "grace"):  # waits at the end
        refused(lambda account=account: office.people.sign_in(account, "wrong"))
    assert hashed == ["wrong"] * 7


def test_wrong_passwords_lock_out_with_growing_waits(office: Office) -> None:
    waits: list[float] = []
    for _ in range(4):
        refused(lambda: office.people.sign_in("grace", "wrong"))
    for _ in range(7):
        refused(lambda: office.people.sign_in("grace", "wrong"))
        now = office.clock.utc_now().timestamp()
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


def test_hashes_follow_the_parameters_of_today(office: Office, tmp_path: Path) -> None:
    assert PasswordHasher().type is Type.ID
    stronger = People(office.store, PasswordHasher(time_cost=2, memory_cost=16, parallelism=1))
    stronger.sign_in("grace", password_of("grace"))
    with closing(sqlite3.connect(database_path(office.data))) as connection:
        stored = dict(connection.execute("SELECT account, password_hash FROM accounts"))
    assert "m=16,t=2" in stored["grace"]
    assert "m=8,t=1" in stored["emmy"]
    office.enter("grace")  # and the old process still accepts it


# --- the lock of a screen ------------------------------------------------------------------------------------


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


# --- what administrators change ------------------------------------------------------------------------------


def test_a_changed_role_ends_the_sign_ins(office: Office) -> None:
    token, _ = office.enter("grace")
    _, administrator = office.enter("ada")
    office.people.accounts.change_role(administrator, "grace", "auditor", "moved to quality")
    assert office.person(token) is None
    assert ("role", "technician", "auditor", "moved to quality") in office.changes("grace")
    _, again = office.enter("grace")
    assert again.role == "auditor"


def test_disabling_shuts_out_at_once_and_enabling_lets_in_again(office: Office) -> None:
    token, _ = office.enter("grace")
    _, administrator = office.enter("ada")
    office.people.accounts.disable(administrator, "grace", "left the house")
    assert office.person(token) is None
    with pytest.raises(SignInRefusedError):
        office.people.sign_in("grace", password_of("grace"))
    office.people.accounts.enable(administrator, "grace", "came back")
    office.enter("grace")


def test_a_disabled_persons_link_is_void(office: Office) -> None:
    _, administrator = office.enter("ada")
    link = office.people.accounts.invite(administrator, "mary", "Mary Shelley", "auditor")
    office.people.accounts.disable(administrator, "mary", "never came")
    with pytest.raises(LinkError):
        office.people.accounts.accept(link, "a good password", PIN)


def test_there_is_always_an_administrator(office: Office) -> None:
    _, administrator = office.enter("ada")
    for act in (
        lambda: office.people.accounts.disable(administrator, "ada", "a reason"),
        lambda: office.people.accounts.change_role(administrator, "ada", "auditor", "a reason"),
        lambda: office.people.accounts.reset(administrator, "ada", "a reason"),
    ):
        with pytest.raises(AccountError, match="last active administrator"):
            act()
    office.people.accounts.change_role(administrator, "emmy", "administrator", "second one")
    office.people.accounts.disable(administrator, "ada", "retires")
    assert office.people.first_link() is None


def test_a_reset_takes_the_password_away_and_makes_a_link(office: Office) -> None:
    token, _ = office.enter("grace")
    _, administrator = office.enter("ada")
    link = office.people.accounts.reset(administrator, "grace", "forgot it")
    assert office.person(token) is None
    with pytest.raises(SignInRefusedError):
        office.people.sign_in("grace", password_of("grace"))
    office.people.accounts.accept(link, "another password", "99887")
    office.people.sign_in("grace", "another password")


@pytest.mark.parametrize("reason", ["", "  ", "x", "y" * 501])
def test_changes_need_a_reason(office: Office, reason: str) -> None:
    _, administrator = office.enter("ada")
    with pytest.raises(AccountError, match="reason"):
        office.people.accounts.disable(administrator, "grace", reason)
    assert office.people.accounts.get("grace").state == "active"


def test_an_administrator_ends_a_wait(office: Office) -> None:
    _, administrator = office.enter("ada")
    for _ in range(5):
        refused(lambda: office.people.sign_in("grace", "wrong"))
    office.people.accounts.end_wait(administrator, "grace")
    office.enter("grace")


def test_a_new_password_signs_out_the_other_screens(office: Office) -> None:
    other, _ = office.enter("grace")
    token, person = office.enter("grace")
    office.people.accounts.change_password(person, "quite another one")
    assert office.person(other) is None
    assert office.person(token) is not None
    with pytest.raises(SignInRefusedError):
        office.people.sign_in("grace", password_of("grace"))


def test_a_password_is_the_same_from_every_keyboard(office: Office) -> None:
    _, person = office.enter("grace")
    office.people.accounts.change_password(person, "un café très noir")
    office.people.sign_in("grace", unicodedata.normalize("NFD", "un café très noir"))


def test_roles_as_the_house_has_them() -> None:
    assert [role for role in ROLES if may(role, "read")] == list(ROLES)
    assert {role for role in ROLES if may(role, "operate")} == {"technician", "supervisor"}
    assert {role for role in ROLES if may(role, "release")} == {"supervisor"}
    assert {role for role in ROLES if may(role, "administer")} == {"administrator"}
    assert [p for p in ("operate", "sign", "correct", "release", "export", "administer") if may("auditor", p)] == []


# --- the record ----------------------------------------------------------------------------------------------


def test_no_secret_reaches_the_record_or_the_database_in_clear(office: Office) -> None:
    secrets = {PIN, "typed into the wrong field", "wrong password 1"}
    token, person = office.enter("grace")
    _, administrator = office.enter("ada")
    link = office.people.accounts.invite(administrator, "mary", "Mary Shelley", "auditor")
    refused(lambda: office.people.sign_in("typed into the wrong field", "wrong password 1"))
    refused(lambda: office.people.unlock(person, "135790"))
    office.people.accounts.change_password(person, "a password of tomorrow")
    office.people.accounts.change_pin(person, "97531")
    secrets |= {password_of("grace"), password_of("ada"), "a password of tomorrow", "97531", "135790", token, link}
    with closing(sqlite3.connect(database_path(office.data))) as connection:
        tables = ("accounts", "sessions", "invitations", "events", "control")
        text = "\n".join(str(row) for table in tables for row in connection.execute(f"SELECT * FROM {table}"))
    # Short digit sequences occur in times and hashes by chance: search for a PIN as a separate value.
    found = [secret for secret in secrets if re.search(rf"(?<![0-9A-Za-z]){re.escape(secret)}(?![0-9A-Za-z])", text)]
    assert found == []
    assert person.csrf not in "\n".join(event.model_dump_json() for event in office.store.events(SITE))
    assert verify(office.data, SITE).ok


def test_what_cannot_be_recorded_does_not_happen(office: Office, monkeypatch: pytest.MonkeyPatch) -> None:
    token, person = office.enter("grace")
    _, administrator = office.enter("ada")
    before = (office.people.accounts.all(), office.people.screens("grace"), len(office.store.events(SITE)))

    class NoRecordError(Exception):
        """The chain cannot be written."""

    def no_record(*_args: object, **_more: object) -> None:
        raise NoRecordError

    monkeypatch.setattr(Store, "append_site", no_record)
    for act in (
        lambda: office.people.sign_in("grace", password_of("grace")),
        lambda: office.people.sign_in("grace", "wrong"),
        lambda: office.people.sign_out(person),
        lambda: office.people.lock(person),
        lambda: office.people.unlock(person, PIN),
        lambda: office.people.accounts.invite(administrator, "mary", "Mary Shelley", "auditor"),
        lambda: office.people.accounts.disable(administrator, "grace", "a reason"),
        lambda: office.people.accounts.change_role(administrator, "grace", "auditor", "a reason"),
        lambda: office.people.accounts.reset(administrator, "grace", "a reason"),
        lambda: office.people.accounts.change_password(person, "quite another one"),
        lambda: office.people.accounts.change_pin(person, "1122334"),
        lambda: office.people.accounts.end_wait(administrator, "grace"),
    ):
        with pytest.raises(NoRecordError):
            act()
    monkeypatch.undo()
    assert (office.people.accounts.all(), office.people.screens("grace"), len(office.store.events(SITE))) == before
    assert office.person(token) is not None
    office.people.check_password("grace", password_of("grace"))


def test_a_crash_at_the_commit_leaves_neither_change_nor_record(tmp_path: Path) -> None:
    with Store.open(tmp_path / "data", SteppedClock()) as store:
        populate(People(store, QUICK_HASHES))
        events = len(store.events(SITE))
    files = CrashingFiles()
    with Store.open(tmp_path / "data", SteppedClock(), files=files) as store:
        people = People(store, QUICK_HASHES)
        files.crash_at = len(files.points) + 1  # within the next commit
        with pytest.raises(BaseException, match="commit"):
            people.sign_in("grace", password_of("grace"))
    with Store.open(tmp_path / "data", SteppedClock()) as store:
        assert len(store.events(SITE)) == events
        assert People(store, QUICK_HASHES).screens("grace") == []
