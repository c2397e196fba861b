"""Reads and writes the rows of accounts and sign-ins, records every change, and says how accounts may be named."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping
from typing import Any, cast

from sqlalchemy import Connection, Row, delete, select

from service.core.errors import ConfigurationError
from service.core.records.entered import looks_of, person_name
from service.core.records.events import AccountChanged, Event, SignInRecorded
from service.people.person import Account, AccountError, Person, Role
from service.store.database.tables import accounts, sessions
from service.store.events import sha256_text
from service.store.store import Store
from service.store.verification.people_checks import session_sha256

SERVICE = "web"  # actor of events that no signed-in person caused
SESSION_S = 12 * 3600.0


def find_account(connection: Connection, account: str) -> Row[Any] | None:
    """Return the row of an account, or None."""
    return connection.execute(select(accounts).where(accounts.c.account == account)).one_or_none()


def get_account(connection: Connection, account: str) -> Row[Any]:
    """Return the row of an account. Raises AccountError if there is none."""
    row = find_account(connection, account)
    if row is None:
        raise AccountError(f"there is no account {account!r}", where="account", remedy="See the list of accounts")
    return row


def full_names(connection: Connection) -> dict[str, str]:
    """Return the full name of every account by its name, disabled ones included."""
    rows = connection.execute(select(accounts.c.account, accounts.c.full_name))
    return {row.account: row.full_name for row in rows}


def named(account: str, full_names: Mapping[str, str]) -> str:
    """Return a person's name in documents: `Full Name (account)`, or just the account."""
    full_name = full_names.get(account, "")
    return f"{full_name} ({account})" if full_name and full_name != account else account


def to_account(row: Row[Any]) -> Account:
    """Return a row of `accounts` as an Account, without its secrets."""
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
    """Return the person in a row of `sessions` joined with `accounts`."""
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

    `secrets` holds new secrets by column, as they are stored; only their hashes go into the chain.
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


ACCOUNT_CHARACTERS = (2, 32)
FULL_NAME_CHARACTERS = (2, 80)
_BETWEEN = frozenset("._-'")


def plain_name(typed: str) -> str:
    """Return the account name for a typed name: lower case, in Unicode's form NFKC, without outer blanks."""
    return unicodedata.normalize("NFKC", typed).strip().lower()


def require_account_name(typed: str) -> str:
    """Return the name of a new account. Raises AccountError if it cannot be one."""
    name = _checked(plain_name(typed), "account", ACCOUNT_CHARACTERS)
    parts = all(c in _BETWEEN or c.isdecimal() or unicodedata.category(c)[0] in "LM" for c in name)
    if not parts or not name[0].isalpha() or name[-1] in _BETWEEN:
        raise AccountError(
            "this cannot be the name of an account",
            where="account",
            remedy="Use 2 to 32 letters, digits, dots, dashes or underscores, a letter first and none of . _ - last",
        )
    return name


def require_full_name(typed: str) -> str:
    """Return the name of a new account's owner. Raises AccountError if it cannot be one."""
    return _checked(typed, "full_name", FULL_NAME_CHARACTERS)


def require_unlike_others(connection: Connection, account: str, full_name: str) -> None:
    """Raise AccountError if a new account could be taken for one that exists. Two people may have the same name."""
    for other, theirs in full_names(connection).items():
        if account == other:
            raise AccountError(
                f"there is an account {other} already", where="account", remedy="Choose another, or reset that one"
            )
        if looks_of(account) == looks_of(other):
            raise AccountError(f"{account} looks like the account {other}", where="account", remedy="Choose another")
        looks_alike = full_name != theirs and looks_of(full_name) in (looks_of(theirs), looks_of(other))
        if looks_alike:
            raise AccountError(
                f"the name looks like that of {other}, and is another one",
                where="full_name",
                remedy="Give first and last name, in the letters in which the person writes it",
            )


def _checked(typed: str, where: str, characters: tuple[int, int]) -> str:
    try:
        name = person_name(typed)
    except ConfigurationError as error:
        raise AccountError(error.what, where=where, remedy=error.remedy) from error
    least, most = characters
    if not least <= len(name) <= most:
        raise AccountError(
            f"the name has {len(name)} characters", where=where, remedy=f"Use {least} to {most} characters"
        )
    return name
