"""Rows of accounts and sign-ins, and the events in the site's chain that record every change of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from sqlalchemy import Connection, Row, delete, select

from service.core.records.events import AccountChanged, Event, SignInRecorded
from service.people.errors import AccountError
from service.people.person import Account, Person
from service.people.roles import Role
from service.store.database.tables import accounts, sessions
from service.store.events import sha256_text
from service.store.store import Store
from service.store.verification.people_checks import session_sha256

SERVICE = "web"  # actor of events that no signed-in person caused
SESSION_S = 12 * 3600.0


def find_account(connection: Connection, account: str) -> Row[Any] | None:
    """The row of an account, or None."""
    return connection.execute(select(accounts).where(accounts.c.account == account)).one_or_none()


def get_account(connection: Connection, account: str) -> Row[Any]:
    """The row of an account. Raises AccountError if there is none."""
    row = find_account(connection, account)
    if row is None:
        raise AccountError(f"there is no account {account!r}", where="account", remedy="See the list of accounts")
    return row


def full_names(connection: Connection) -> dict[str, str]:
    """Full name of every account by its name, disabled ones included."""
    rows = connection.execute(select(accounts.c.account, accounts.c.full_name))
    return {row.account: row.full_name for row in rows}


def named(account: str, full_names: Mapping[str, str]) -> str:
    """A person's name in documents: `Full Name (account)`, or just the account."""
    full_name = full_names.get(account, "")
    return f"{full_name} ({account})" if full_name and full_name != account else account


def to_account(row: Row[Any]) -> Account:
    """A row of `accounts` as an Account, without its secrets."""
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
    """The person in a row of `sessions` joined with `accounts`."""
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
    change: AccountChanged,
    secrets: Mapping[str, str] | None = None,
) -> Event:
    """Record a change of an account in the transaction that makes it. Returns the event.

    `secrets` holds the stored forms of new secrets by column; only their hashes go into the chain.
    """
    hashes = {column: sha256_text(value) for column, value in (secrets or {}).items()}
    (event,) = store.append_site(connection, [change.model_copy(update={"stored": hashes})], actor=actor)
    return event


def record_sign_in(
    store: Store,
    connection: Connection,
    sign_in: SignInRecorded,
    *,
    actor: str = SERVICE,
    session: Mapping[str, Any] | None = None,
) -> None:
    """Record the outcome of a sign-in in its transaction. The hash of `session`, the row of a new one, is added."""
    known = "" if session is None else session_sha256(session)
    store.append_site(connection, [sign_in.model_copy(update={"session_sha256": known})], actor=actor)


def end_sessions(store: Store, connection: Connection, account: str, *, actor: str, keep: str = "") -> None:
    """End and record all sign-ins of an account except that of the screen `keep`."""
    chosen = (sessions.c.account == account) & (sessions.c.screen != keep)
    for row in connection.execute(select(sessions.c.screen).where(chosen)).all():
        outcome = SignInRecorded(account=account, outcome="ended", screen=row.screen)
        record_sign_in(store, connection, outcome, actor=actor)
    connection.execute(delete(sessions).where(chosen))
