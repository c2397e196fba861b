"""PINs and badges are bound to a key outside the database, and old hashes are renewed."""

from __future__ import annotations

from pathlib import Path

import pytest
from argon2 import PasswordHasher
from argon2.exceptions import VerifyMismatchError
from sqlalchemy import text

from service.people.person import PinRefusedError
from service.people.sessions import People
from service.store.backup import BackupOptions, back_up
from service.store.records import SITE
from service.store.restoring import restore
from service.store.verification.verify import verify
from tests.support.pages.web import PIN, QUICK_HASHES, password_of
from tests.support.record.office import Office
from tests.support.record.outsider import outsider

PEPPER = Path("keys", "pepper")


def stored(data: Path, column: str) -> str:
    with outsider(data) as connection:
        (found,) = connection.execute(f"SELECT {column} FROM accounts WHERE account = 'grace'").fetchone()
    return str(found)


def store_old(office: Office, column: str, secret: str) -> None:
    """Store the hash that an earlier version would have stored."""
    old = {"secret": QUICK_HASHES.hash(secret)}
    with office.store.database.writing() as connection:
        connection.execute(text(f"UPDATE accounts SET {column} = :secret WHERE account = 'grace'"), old)


def test_who_has_the_database_alone_cannot_guess_a_pin(office: Office) -> None:
    kept = stored(office.data, "pin_hash")
    assert (office.data / PEPPER).stat().st_mode & 0o777 == 0o600
    with pytest.raises(VerifyMismatchError):
        PasswordHasher().verify(kept.rpartition(":")[2], PIN)
    office.people.check_secret("grace", "pin", PIN)


def test_old_hashes_are_accepted_and_renewed_at_their_next_use(office: Office) -> None:
    _, ada = office.enter("ada")
    office.people.badges.enrol(ada, "grace", password_of("grace"), "0004711815")
    for known_by, secret in (("pin", PIN), ("badge", "0004711815")):
        column = f"{known_by}_hash"
        store_old(office, column, secret)
        office.people.check_secret("grace", known_by, secret)  # type: ignore[arg-type]
        assert stored(office.data, column).startswith("hmac-sha256:")
        office.people.check_secret("grace", known_by, secret)  # type: ignore[arg-type]
    store_old(office, "pin_hash", PIN)
    _, grace = office.enter("grace")
    office.people.lock(grace)
    office.people.unlock(grace, PIN)
    assert stored(office.data, "pin_hash").startswith("hmac-sha256:")
    assert ("pin", "set", "hashed anew", "") in office.changes("grace")
    assert verify(office.data, SITE).ok


def test_without_its_key_a_pin_is_set_again_with_the_password(office: Office) -> None:
    (office.data / PEPPER).unlink()
    people = People(office.store, QUICK_HASHES)
    token = people.sign_in("grace", password_of("grace"))
    grace = people.person(token, idle_lock_s=600.0, deliberate=False)
    assert grace is not None
    people.lock(grace)
    with pytest.raises(PinRefusedError, match="was replaced"):
        people.unlock(grace, PIN)
    people.accounts.change_pin(grace, PIN)
    people.unlock(grace, PIN)


@pytest.mark.sqlite("backups and journal: a server has its own")
def test_a_backup_holds_the_key_of_the_pins_with_the_other_keys_only(office: Office, tmp_path: Path) -> None:
    for keys in (False, True):
        report = back_up(office.data, tmp_path / "backup", BackupOptions(with_keys=keys), clock=office.clock)
        assert (report.folder / "states" / report.name / PEPPER).exists() is keys
        office.clock.passed_s += 1.0
    assert restore(tmp_path / "backup", tmp_path / "again", actor=lambda _: "ada").ok
    assert (tmp_path / "again" / PEPPER).read_bytes() == (office.data / PEPPER).read_bytes()
