"""Accounts: how they are made and changed, what is recorded, and that secrets never are."""

from __future__ import annotations

import re
import unicodedata
from pathlib import Path

import pytest

from service.people.person import ROLES, AccountError, LinkError, SignInRefusedError, may
from service.people.sessions import People
from service.store.records import SITE
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.web import PIN, QUICK_HASHES, password_of, populate
from tests.support.record.office import Office, refused
from tests.support.record.outsider import is_postgres, outsider
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import CrashingFiles


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


@pytest.mark.parametrize("name", ["", "x", "runner", "web", "9lives", "a b", "a/../b", "x" * 40, "a\u0000b"])
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


def test_a_link_lives_no_longer_because_the_clock_was_set_back(office: Office) -> None:
    _, administrator = office.enter("ada")
    link = office.people.accounts.invite(administrator, "mary", "Mary Shelley", "auditor")
    (change,) = [change for change in office.changes("mary") if change[0] == "link"]
    hours = float(change[2].split()[2])
    office.clock.set_utc(-3600.0)
    office.clock.passed_s += 3600 * hours - 1
    assert office.people.accounts.invitation(link).account == "mary"
    office.clock.passed_s += 1
    with pytest.raises(LinkError):
        office.people.accounts.invitation(link)


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


@pytest.mark.parametrize("reason", ["", "  ", "y" * 2001])
def test_changes_need_a_reason(office: Office, reason: str) -> None:
    _, administrator = office.enter("ada")
    with pytest.raises(AccountError, match="reason"):
        office.people.accounts.disable(administrator, "grace", reason)
    assert office.people.accounts.get("grace").state == "active"


def test_an_administrator_ends_a_wait(office: Office) -> None:
    _, administrator = office.enter("ada")
    for _ in range(5):
        refused(lambda: office.people.sign_in("grace", "wrong"))
    office.people.accounts.end_wait(administrator.account, "grace")
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
    assert {role for role in ROLES if may(role, "report")} == {"supervisor", "auditor"}


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
    with outsider(office.data) as connection:
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
        lambda: office.people.accounts.end_wait(administrator.account, "grace"),
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
        # Within the next commit; with SQLite after a line of the journal and its sync.
        files.crash_at = len(files.points) + (1 if is_postgres(tmp_path / "data") else 7)
        with pytest.raises(BaseException, match="within commit"):
            people.sign_in("grace", password_of("grace"))
    with Store.open(tmp_path / "data", SteppedClock()) as store:
        assert len(store.events(SITE)) == events
        assert People(store, QUICK_HASHES).screens("grace") == []
