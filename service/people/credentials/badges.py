"""Badges, whose readers type a code: they may sign where the site allows it. Hashed and recorded like PINs."""

from __future__ import annotations

from collections.abc import Callable

from sqlalchemy import select, update

from service.core.records.events import AccountChanged
from service.core.text.reasons import reason_of
from service.people.credentials.passwords import ShortSecrets, plain_badge
from service.people.credentials.tries import SecretOrigin, on_screen_of
from service.people.errors import AccountError
from service.people.person import Person
from service.people.rows import get_account, record_change
from service.store.database.tables import accounts
from service.store.store import Store


class Badges:
    """Enrolling and revoking badges, by supervisors and administrators."""

    def __init__(
        self, store: Store, codes: ShortSecrets, check_password: Callable[[str, str, SecretOrigin], None]
    ) -> None:
        self._store = store
        self._codes = codes
        self._check_password = check_password

    def enrol(self, by: Person, account: str, password: str, badge: str) -> None:
        """Give an account a badge, which replaces its old one.

        The owner agrees by giving the account's password; otherwise whoever enrols badges could sign as anybody.

        Raises:
            AccountError: the code is not a badge's, or the badge belongs to somebody else.
            SignInRefusedError: the password is wrong.
        """
        plain = plain_badge(badge)
        self._check_password(account, password, on_screen_of(by))
        if any(self._codes.matches(stored, plain) for stored in self._others(account)):
            raise AccountError(
                "this badge belongs to somebody else", where="badge", remedy="Revoke it there first, or use another"
            )
        self._set(by, account, self._codes.hash(plain), "enrolled")

    def revoke(self, by: Person, account: str, reason: str) -> None:
        """Revoke an account's badge, so that it can no longer sign. Raises AccountError."""
        self._set(by, account, "", "revoked", reason_of(reason, AccountError))

    def _others(self, account: str) -> list[str]:
        with self._store.database.reading() as connection:
            rows = connection.execute(
                select(accounts.c.badge_hash).where(accounts.c.account != account, accounts.c.badge_hash != "")
            )
            return [row.badge_hash for row in rows]

    def _set(self, by: Person, account: str, stored: str, new: str, reason: str = "") -> None:
        values = {"badge_hash": stored}
        with self._store.database.writing() as connection:
            row = get_account(connection, account)
            if not stored and not row.badge_hash:
                raise AccountError(f"{account} has no badge", where="badge", remedy="Nothing has to be done")
            connection.execute(update(accounts).where(accounts.c.account == account).values(**values))
            old = "enrolled" if row.badge_hash else ""
            change = AccountChanged(account=account, field="badge", old=old, new=new, reason=reason)
            record_change(self._store, connection, by.account, change, values)
