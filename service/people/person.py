"""People: records of accounts, screens and links, what each role may do, and the rows that hold them."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, cast

from sqlalchemy import Connection, Row, delete, select

from service.core.errors import ConfigurationError, OrthocaptureError
from service.core.records.entered import looks_of, person_name
from service.core.records.events import AccountChanged, Event, SignInRecorded
from service.store.database.tables import accounts, sessions
from service.store.events import sha256_text
from service.store.store import Store
from service.store.verification.people_checks import session_sha256


class PeopleError(OrthocaptureError):
    """A person's request was refused; nothing was changed."""


class NotSignedInError(PeopleError):
    """Nobody is signed in on this screen, or the sign-in has ended."""


class SignInRefusedError(PeopleError):
    """Name or password is wrong, or the account may not sign in now; which of these is deliberately not said."""


class AccountJustChangedError(SignInRefusedError):
    """The password was right, but the account was changed meanwhile; this does not count as a failed try."""


class TooManyTriesError(PeopleError):
    """Too many failed tries from one address; `wait_s` says how long to wait."""

    wait_s: float = 60.0


class NotAllowedError(PeopleError):
    """The person's role does not have the permission, or the request did not come from the person's own page."""


class ScreenLockedError(PeopleError):
    """The screen is locked: it shows pages but allows no actions."""


class PinRefusedError(PeopleError):
    """The PIN is wrong."""


class LinkError(PeopleError):
    """A one-time link is unknown, used, or too old."""


class AccountError(PeopleError):
    """An account cannot be made or changed like this."""


class ControlError(PeopleError):
    """Another screen has control of the run, or nobody has."""


Role = Literal["technician", "supervisor", "auditor", "administrator"]
Permission = Literal[
    "read",  # every page of every run, audit pages included
    "operate",  # start and drive a run: tick, confirm, redo, skip, pause, resume, abort; take control
    "sign",  # sign a step
    "correct",  # correct a recorded value, with reason
    "release",  # release a completed run as second person
    "enrol",  # enrol and revoke people's badges
    "report",  # make a report or an evidence bundle
    "export",  # make a data set
    "administer",  # accounts, invitations, signing key
]
ROLES: tuple[Role, ...] = ("technician", "supervisor", "auditor", "administrator")
_GRANTED: dict[Role, frozenset[Permission]] = {
    "technician": frozenset({"read", "operate", "sign"}),
    "supervisor": frozenset({"read", "operate", "sign", "correct", "release", "report", "export", "enrol"}),
    "auditor": frozenset({"read", "report"}),
    "administrator": frozenset({"read", "administer", "enrol"}),
}


def may(role: Role, permission: Permission) -> bool:
    """Return whether a role has a permission."""
    return permission in _GRANTED[role]


@dataclass(frozen=True, slots=True)
class Person:
    """A person signed in on one screen."""

    account: str
    full_name: str
    role: Role
    screen: str  # name of this sign-in, for people and for the record
    csrf: str = field(repr=False)  # token that every form of this sign-in carries
    locked: bool = False

    def may(self, permission: Permission) -> bool:
        """Return whether the person's role has a permission."""
        return may(self.role, permission)


@dataclass(frozen=True, slots=True)
class Account:
    """An account as administrators see it."""

    account: str
    full_name: str
    role: Role
    state: str  # invited, active, disabled
    failures: int  # wrong passwords in a row
    locked_until_utc_s: float  # 0 if not locked out
    created_utc: str
    badge: bool  # true if it has a badge


@dataclass(frozen=True, slots=True)
class Screen:
    """A sign-in that is still valid."""

    screen: str
    account: str
    created_utc_s: float
    seen_utc_s: float
    locked: bool


@dataclass(frozen=True, slots=True)
class Invitation:
    """The purpose of a one-time link. `account` is "" for the first administrator, who chooses a name."""

    account: str
    full_name: str
    role: Role


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
