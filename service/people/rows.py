"""Reading and recording people: rows of accounts and sign-ins, and the site's events that go with every change."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Literal, cast

from sqlalchemy import Connection, Row, delete, select

from service.core.records.events import AccountChanged, Event, SignInRecorded
from service.people.errors import AccountError
from service.people.person import Account, Person
from service.people.roles import Role
from service.store.database.tables import accounts, sessions
from service.store.events import sha256_text
from service.store.store import Store
from service.store.verification.people_checks import session_sha256

SERVICE = "web"  # actor of what happens without anybody signed in
SESSION_S = 12 * 3600.0
Outcome = Literal["signed_in", "refused", "locked_out", "signed_out", "screen_locked", "screen_unlocked", "ended"]
_NAME = re.compile(r"[a-z][a-z0-9._-]{1,31}")
_RESERVED = frozenset({"web", "runner", "worker", "site", "service", "camera", "robot", "orthocapture", "nobody"})


def plain_name(typed: str) -> str:
    """The account that a typed name means: letters of either case are the same."""
    return typed.strip().lower()


def require_name(name: str) -> None:
    """Raises AccountError for a name that cannot be an account's."""
    if not _NAME.fullmatch(name):
        raise AccountError(
            "this cannot be the name of an account",
            where="account",
            remedy="Use 2 to 32 letters a-z, digits, dots, dashes or underscores, a letter first",
        )
    if name in _RESERVED:
        raise AccountError(f"{name} is a name of the system itself", where="account", remedy="Choose another one")


def require_full_name(name: str) -> str:
    """The name without outer blanks. Raises AccountError for one that cannot stand in a record."""
    plain = " ".join(name.split())
    if not 2 <= len(plain) <= 80 or not plain.isprintable():
        raise AccountError(
            "this cannot be a person's name",
            where="full_name",
            remedy="Give first and last name, up to 80 characters",
        )
    return plain


def require_reason(reason: str) -> str:
    """The reason without outer blanks. Raises AccountError when there is none."""
    plain = reason.strip()
    if not 3 <= len(plain) <= 500:
        raise AccountError(
            "a reason is needed", where="reason", remedy="Say why in a few words, up to 500 characters"
        )
    return plain


def find_account(connection: Connection, account: str) -> Row[Any] | None:
    """The row of an account, if there is one."""
    return connection.execute(select(accounts).where(accounts.c.account == account)).one_or_none()


def get_account(connection: Connection, account: str) -> Row[Any]:
    """The row of an account. Raises AccountError."""
    row = find_account(connection, account)
    if row is None:
        raise AccountError(f"there is no account {account!r}", where="account", remedy="See the list of accounts")
    return row


def full_names(connection: Connection) -> dict[str, str]:
    """Full name of every account, closed ones included."""
    rows = connection.execute(select(accounts.c.account, accounts.c.full_name))
    return {row.account: row.full_name for row in rows}


def named(account: str, full_names: Mapping[str, str]) -> str:
    """A person as documents name them: full name, then the account that the records have."""
    full_name = full_names.get(account, "")
    return f"{full_name} ({account})" if full_name and full_name != account else account


def to_account(row: Row[Any]) -> Account:
    """A row without its secrets."""
    return Account(
        account=row.account,
        full_name=row.full_name,
        role=cast(Role, row.role),
        state=row.state,
        failures=row.failures,
        locked_until_utc_s=row.locked_until_utc_s,
        created_utc=row.created_utc,
        badge=bool(row.badge_hash),
    )


def to_person(row: Row[Any]) -> Person:
    """Who a row of sessions joined with accounts stands for."""
    return Person(
        account=row.account,
        full_name=row.full_name,
        role=cast(Role, row.role),
        screen=row.screen,
        csrf=row.csrf,
        locked=bool(row.locked),
    )


def record_change(
    store: Store,
    connection: Connection,
    actor: str,
    account: str,
    field: str,
    old: str,
    new: str,
    reason: str = "",
    *,
    full_name: str = "",
    stored: Mapping[str, str] | None = None,
) -> Event:
    """Append that an account changed, in the transaction that changes it.

    `stored`: what is kept of secrets that it sets, by column; only the hash of it goes into the chain.
    """
    hashes = {column: sha256_text(value) for column, value in (stored or {}).items()}
    change = AccountChanged(
        account=account, field=field, old=old, new=new, reason=reason, full_name=full_name, stored=hashes
    )
    (event,) = store.append_site(connection, [change], actor=actor)
    return event


def record_sign_in(
    store: Store,
    connection: Connection,
    outcome: Outcome,
    *,
    account: str,
    screen: str = "",
    address: str = "",
    actor: str = SERVICE,
    session: Mapping[str, Any] | None = None,
) -> None:
    """Append what happened to a sign-in, in the transaction in which it happens. `session`: the row of a new one."""
    known = "" if session is None else session_sha256(session)
    event = SignInRecorded(account=account, outcome=outcome, screen=screen, address=address, session_sha256=known)
    store.append_site(connection, [event], actor=actor)


def end_sessions(store: Store, connection: Connection, account: str, *, actor: str, keep: str = "") -> None:
    """End all sign-ins of an account, but the screen `keep`; each is recorded."""
    chosen = (sessions.c.account == account) & (sessions.c.screen != keep)
    for row in connection.execute(select(sessions.c.screen).where(chosen)).all():
        record_sign_in(store, connection, "ended", account=account, screen=row.screen, actor=actor)
    connection.execute(delete(sessions).where(chosen))
