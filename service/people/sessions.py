"""People at screens and terminals: signing in and out, locking, asking again before a signature, and who acts."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf
from threading import Lock
from typing import Any, Literal

from argon2 import PasswordHasher
from sqlalchemy import Connection, Row, bindparam, delete, insert, select, update

from service.core.errors import ConfigurationError
from service.core.gates import demanded_role
from service.core.protocol import Protocol
from service.core.records.base import age_s
from service.core.records.entered import cleaned_name, person_name
from service.core.records.events import AccountChanged, SignInRecorded
from service.core.run.state import RunState
from service.people.accounts import Accounts, Badges
from service.people.credentials import (
    FIRST_WAIT_S,
    FREE_FAILURES,
    LONGEST_WAIT_S,
    TERMINAL,
    KnownTries,
    Passwords,
    Pepper,
    SecretOrigin,
    ShortSecrets,
    new_token,
    token_sha256,
    wait_after_s,
)
from service.people.person import (
    ROLES,
    SERVICE,
    SESSION_S,
    AccountError,
    AccountJustChangedError,
    NotAllowedError,
    NotSignedInError,
    Permission,
    Person,
    PinRefusedError,
    Screen,
    SignInRefusedError,
    find_account,
    get_account,
    may,
    plain_name,
    record_change,
    record_sign_in,
    to_account,
    to_person,
)
from service.store.database.tables import accounts, sessions
from service.store.store import Store

_SCREEN_LETTERS = "23456789ABCDEFGHJKMNPQRSTVWXYZ"


KnownBy = Literal["password", "pin", "badge"]  # the secret with which a person signs
NAMES: Mapping[KnownBy, str] = {"password": "password", "pin": "PIN", "badge": "badge"}
_SESSION = (  # put together once: every page asks it
    select(sessions, accounts.c.full_name, accounts.c.role, accounts.c.state)
    .join(accounts, sessions.c.account == accounts.c.account)
    .where(sessions.c.token_sha256 == bindparam("token"))
)


class People:
    """Accounts and sign-ins of a data folder. Every change and its event in the site's chain are one transaction."""

    def __init__(self, store: Store, hasher: PasswordHasher | None = None) -> None:
        self._store = store
        self._passwords = Passwords(hasher)
        # One check at a time, so that every guess is counted before the next and argon2's memory stays bounded.
        self._one_guess = Lock()
        self._short = ShortSecrets(self._passwords, Pepper(store))
        self._known = KnownTries(store)
        self.accounts = Accounts(store, self._passwords, self._short, self._known)
        self.badges = Badges(store, self._short, self.check_password)

    def first_link(self) -> str | None:
        """Make a one-time token for the page /set-up/TOKEN, voiding earlier ones; None if an administrator exists."""
        return self.accounts.first_link()

    # --- passwords ---

    def sign_in(self, account: str, password: str, *, address: str = "", replaces: str = "") -> str:
        """Sign in and return the token for the cookie. `replaces` is the browser's old token, which ends.

        Raises SignInRefusedError, with the same words and after the same time whatever the cause.
        """
        with self._one_guess:
            origin = SecretOrigin(address=address)
            row = self._checked(account, password, origin)
            token = new_token()
            now = self._store.clock.utc_s()
            with self._store.database.writing() as connection:
                self._require_unchanged(connection, row)
                self._end(connection, replaces)
                self._end_expired(connection, now)
                screen = "".join(secrets.choice(_SCREEN_LETTERS) for _ in range(6))
                session: dict[str, Any] = {
                    "token_sha256": token_sha256(token),
                    "account": row.account,
                    "screen": screen,
                    "csrf": new_token(),
                    "created_utc_s": now,
                }
                self._store.ages.begin(now)
                connection.execute(insert(sessions).values(**session, seen_utc_s=now, locked=0, pin_failures=0))
                self._reset_failures(connection, row, password, origin)
                outcome = SignInRecorded(account=row.account, outcome="signed_in", screen=screen, address=address)
                record_sign_in(self._store, connection, outcome, actor=row.account, session=session)
            return token

    def may_try(self, account: str, address: str) -> bool:
        """Return whether a person may sign in from an address however many others failed there.

        So may whoever has signed in from there before, and need not wait for wrong passwords of that account.
        """
        name, origin = plain_name(account), SecretOrigin(address=address)
        with self._one_guess:
            return self._known.knows(name, origin) and not self._known.wait_s(name, origin)

    def check_password(self, account: str, password: str, origin: SecretOrigin = TERMINAL) -> None:
        """Check a password again for a signature. A wrong one counts as a failed try: SignInRefusedError."""
        with self._one_guess:
            row = self._checked(account, password, origin)
            if self._passwords.is_outdated(row.password_hash) or not self._known.knows(row.account, origin):
                with self._store.database.writing() as connection:
                    self._require_unchanged(connection, row)
                    self._reset_failures(connection, row, password, origin)
            else:
                self._known.succeeded(row.account, origin)

    def check_secret(self, account: str, known_by: KnownBy, secret: str, origin: SecretOrigin = TERMINAL) -> None:
        """Check a password, PIN or badge again for a signature.

        A wrong one counts as a failed try and raises SignInRefusedError. Only the right password resets the count, so
        that knowing a PIN gives no further guesses at the password.
        """
        if known_by == "password":
            self.check_password(account, secret, origin)
            return
        with self._one_guess:
            plain = secret.strip().upper()
            row = self._checked(account, plain, origin, known_by)
            self._renew(row.account, known_by, row.pin_hash if known_by == "pin" else row.badge_hash, plain)

    def _renew(self, account: str, which: KnownBy, stored: str, secret: str) -> None:
        """Hash a right PIN or badge again if its hash is of an earlier version."""
        if not self._short.is_outdated(stored):
            return
        column = f"{which}_hash"
        values = {column: self._short.hash(secret)}
        with self._store.database.writing() as connection:
            row = find_account(connection, account)
            if row is None or getattr(row, column) != stored:
                return  # it was changed meanwhile
            connection.execute(update(accounts).where(accounts.c.account == account).values(**values))
            change = AccountChanged(account=account, field=which, old="set", new="hashed anew")
            record_change(self._store, connection, account, change, values)

    def refuse_address(self, address: str) -> None:
        """Record that an address has failed too often and must wait."""
        with self._store.database.writing() as connection:
            record_sign_in(self._store, connection, SignInRecorded(account="", outcome="locked_out", address=address))

    def _checked(self, typed: str, secret: str, origin: SecretOrigin, known_by: KnownBy = "password") -> Row[Any]:
        name = plain_name(typed)
        with self._store.database.reading() as connection:
            row = find_account(connection, name)
        known = row is not None and self._known.knows(name, origin)
        waits = row is not None and (self._known.wait_s(name, origin) > 0 if known else self._has_to_wait(row))
        usable = row is not None and row.state == "active" and not waits
        hashes = {} if row is None else {"password": row.password_hash, "pin": row.pin_hash, "badge": row.badge_hash}
        stored = str(hashes[known_by]) if usable else ""
        hashes_of = self._passwords if known_by == "password" else self._short
        matches = hashes_of.matches(stored, secret)
        if row is not None and matches:
            return row
        with self._store.database.writing() as connection:
            if known and not waits:
                self._known.failed(name, origin)
            elif usable:
                waits = self._count_strangers_failure(connection, name)
            # An unknown name is not recorded, because it may be a password typed into the wrong field.
            outcome = SignInRecorded(
                account=row.account if row is not None else "",
                outcome="locked_out" if waits else "refused",
                address=origin.address,
                screen=origin.screen,
            )
            record_sign_in(self._store, connection, outcome, actor=origin.by or SERVICE)
        raise SignInRefusedError(
            f"name and {NAMES[known_by]} do not belong together, or the account has to wait",
            where="password",
            remedy=f"Check both. After {FREE_FAILURES} wrong {NAMES[known_by]}s in a row one waits "
            f"{FIRST_WAIT_S:.0f} s, then longer; an administrator can end the wait",
        )

    def _count_strangers_failure(self, connection: Connection, name: str) -> bool:
        """Count a wrong secret of somebody whom the account does not know; returns whether strangers wait now."""
        failures = get_account(connection, name).failures + 1  # another process may count too
        wait_s = wait_after_s(failures)
        until_s = self._store.clock.utc_s() + wait_s if wait_s else 0.0
        self._store.ages.begin(until_s)
        counted = {"failures": failures, "locked_until_utc_s": until_s}
        connection.execute(update(accounts).where(accounts.c.account == name).values(**counted))
        return wait_s > 0

    def _has_to_wait(self, row: Row[Any]) -> bool:
        """Return whether wrong passwords of strangers have closed the account to them for now.

        A wait longer than the longest comes from a clock that was set back since; it is cut to the longest.
        """
        now = self._store.clock.utc_s()
        if row.locked_until_utc_s > now + LONGEST_WAIT_S:
            with self._store.database.writing() as connection:
                cut = {"locked_until_utc_s": now + LONGEST_WAIT_S}
                connection.execute(update(accounts).where(accounts.c.account == row.account).values(**cut))
        return self.accounts.strangers_wait(to_account(row))

    def _require_unchanged(self, connection: Connection, row: Row[Any]) -> None:
        """Raise AccountJustChangedError if the account has changed since its password was checked."""
        present = find_account(connection, row.account)
        if present is None or present.state != "active" or present.password_hash != row.password_hash:
            raise AccountJustChangedError(
                "the account has just been changed", where="password", remedy="Sign in again"
            )

    def _reset_failures(self, connection: Connection, row: Row[Any], password: str, origin: SecretOrigin) -> None:
        """Start the count again, where the right password was given."""
        values: dict[str, object] = {}
        if not self._known.knows(row.account, origin):
            values = {"failures": 0, "locked_until_utc_s": 0.0}
        self._known.succeeded(row.account, origin)
        if self._passwords.is_outdated(row.password_hash):
            stored = {"password_hash": self._passwords.hash(password)}
            values |= stored
            name = row.account
            change = AccountChanged(account=name, field="password", old="set", new="hashed anew")
            record_change(self._store, connection, name, change, stored)
        if values:
            connection.execute(update(accounts).where(accounts.c.account == row.account).values(**values))

    # --- sign-ins ---

    def person(self, token: str, *, idle_lock_s: float, deliberate: bool) -> Person | None:
        """Return the person with this token, None if it is not valid, and lock a screen that was idle too long.

        Args:
            token: the cookie's token.
            idle_lock_s: the site's limit for idle time, after which the screen is locked.
            deliberate: true if a person acted, rather than the page by itself; only that keeps a screen unlocked.
        """
        now = self._store.clock.utc_s()
        with self._store.database.reading() as connection:
            row = self._session(connection, token)
        if row is None:
            return None
        if row.state != "active" or self._store.ages.at_most_s(row.created_utc_s) >= SESSION_S:
            with self._store.database.writing() as connection:
                self._end(connection, token)
            return None
        # After the clock was set back nobody knows how long the screen was idle; the PIN says that a person is there.
        idle_s = max(age_s(row.seen_utc_s, now, if_set_back_s=inf), self._store.ages.at_most_s(row.seen_utc_s))
        if not row.locked and idle_s >= idle_lock_s:
            with self._store.database.writing() as connection:
                self._lock(connection, row.account, row.screen, actor=SERVICE)
            with self._store.database.reading() as connection:
                row = self._session(connection, token)
        elif deliberate and not row.locked and idle_s >= 1.0:
            self._store.ages.begin(now)
            with self._store.database.writing() as connection:
                connection.execute(update(sessions).where(sessions.c.screen == row.screen).values(seen_utc_s=now))
        return None if row is None else to_person(row)

    def sign_out(self, person: Person) -> None:
        """End this person's sign-in on this screen."""
        with self._store.database.writing() as connection:
            outcome = SignInRecorded(account=person.account, outcome="signed_out", screen=person.screen)
            record_sign_in(self._store, connection, outcome, actor=person.account)
            connection.execute(delete(sessions).where(sessions.c.screen == person.screen))

    def lock(self, person: Person) -> None:
        """Lock this screen until its PIN is given."""
        with self._store.database.writing() as connection:
            self._lock(connection, person.account, person.screen, actor=person.account)

    def unlock(self, person: Person, pin: str) -> None:
        """Unlock a screen. Raises PinRefusedError for a wrong PIN; after too many, ends it with NotSignedInError."""
        with self._one_guess:
            with self._store.database.reading() as connection:
                row = connection.execute(
                    select(accounts.c.pin_hash, sessions.c.pin_failures)
                    .join(sessions, sessions.c.account == accounts.c.account)
                    .where(sessions.c.screen == person.screen)
                ).one_or_none()
            if row is None:
                raise NotSignedInError("this sign-in has ended", remedy="Sign in again")
            if self._short.is_lost(row.pin_hash):
                raise PinRefusedError(
                    "no PIN can be checked: the key to which PINs are bound was replaced",
                    where="pin",
                    remedy="Sign out, sign in with the password, and set a new PIN on the page of your account",
                )
            matches = self._short.matches(row.pin_hash, pin)
            if matches:
                self._renew(person.account, "pin", row.pin_hash, pin)
            failures = 0 if matches else row.pin_failures + 1
            ended = failures >= FREE_FAILURES
            with self._store.database.writing() as connection:
                outcome = SignInRecorded(
                    account=person.account,
                    outcome="screen_unlocked" if matches else "ended" if ended else "refused",
                    screen=person.screen,
                )
                record_sign_in(self._store, connection, outcome, actor=person.account if matches else SERVICE)
                here = sessions.c.screen == person.screen
                if ended:
                    connection.execute(delete(sessions).where(here))
                elif matches:
                    opened = {"locked": 0, "pin_failures": 0, "seen_utc_s": self._store.clock.utc_s()}
                    connection.execute(update(sessions).where(here).values(**opened))
                else:
                    connection.execute(update(sessions).where(here).values(pin_failures=failures))
        if ended:
            raise NotSignedInError(
                f"{FREE_FAILURES} wrong PINs: this sign-in has ended", remedy="Sign in again with the password"
            )
        if not matches:
            left = FREE_FAILURES - failures
            raise PinRefusedError(
                "this is not the PIN",
                where="pin",
                remedy=f"Try again; {left} {'try is' if left == 1 else 'tries are'} left, then sign in again",
            )

    def screens(self, account: str) -> list[Screen]:
        """Return the valid sign-ins of an account, newest first."""
        with self._store.database.reading() as connection:
            rows = connection.execute(
                select(sessions)
                .where(
                    sessions.c.account == account, sessions.c.created_utc_s > self._store.clock.utc_s() - SESSION_S
                )
                .order_by(sessions.c.created_utc_s.desc())
            ).all()
        return [Screen(r.screen, r.account, r.created_utc_s, r.seen_utc_s, bool(r.locked)) for r in rows]

    def end_screen(self, person: Person, screen: str) -> None:
        """End one of a person's own sign-ins, on this or another screen. Raises AccountError if there is none."""
        with self._store.database.writing() as connection:
            chosen = (sessions.c.screen == screen) & (sessions.c.account == person.account)
            if connection.execute(select(sessions.c.screen).where(chosen)).one_or_none() is None:
                raise AccountError(f"you have no sign-in {screen!r}", where="screen", remedy="It may have ended")
            outcome = SignInRecorded(account=person.account, outcome="ended", screen=screen)
            record_sign_in(self._store, connection, outcome, actor=person.account)
            connection.execute(delete(sessions).where(chosen))

    def _session(self, connection: Connection, token: str) -> Row[Any] | None:
        return connection.execute(_SESSION, {"token": token_sha256(token)}).one_or_none()

    def _lock(self, connection: Connection, account: str, screen: str, *, actor: str) -> None:
        changed = connection.execute(
            update(sessions).where(sessions.c.screen == screen, sessions.c.locked == 0).values(locked=1)
        )
        if changed.rowcount:
            outcome = SignInRecorded(account=account, outcome="screen_locked", screen=screen)
            record_sign_in(self._store, connection, outcome, actor=actor)

    def _end_expired(self, connection: Connection, now: float) -> None:
        expired = sessions.c.created_utc_s <= now - SESSION_S
        for row in connection.execute(select(sessions.c.account, sessions.c.screen).where(expired)).all():
            outcome = SignInRecorded(account=row.account, outcome="ended", screen=row.screen)
            record_sign_in(self._store, connection, outcome)
        connection.execute(delete(sessions).where(expired))

    def _end(self, connection: Connection, token: str) -> None:
        row = self._session(connection, token) if token else None
        if row is not None:
            outcome = SignInRecorded(account=row.account, outcome="ended", screen=row.screen)
            record_sign_in(self._store, connection, outcome)
            connection.execute(delete(sessions).where(sessions.c.screen == row.screen))


@dataclass(frozen=True, slots=True)
class Identity:
    """A person as named in an event, and how they were identified."""

    name: str
    role: str
    identified: Literal["claimed", "password", "pin", "badge"]


def identity_for(
    people: People,
    protocol: Protocol,
    state: RunState,
    verb: str,
    typed: str,
    secret: Callable[[], str],
    known_by: KnownBy = "password",
    origin: SecretOrigin = TERMINAL,
) -> Identity | None:
    """Return the person who acts, if the verb now needs a role; else None.

    Raises:
        SignInRefusedError: name and secret do not belong together.
        NotAllowedError: no name was given, or the account has another role.
    """
    role = demanded_role(protocol, state) if verb == "accept" else ""
    return identify(people, typed, role, secret, known_by, origin) if role else None


def who_acts(people: People, typed: str, password: Callable[[], str], permission: Permission) -> Identity:
    """Return the person who acts on the command line: by password where there are accounts, else by claim.

    Args:
        people: accounts of the data folder.
        typed: the name as typed.
        password: asks for the password; not called on a site without accounts.
        permission: the permission that the act needs of the role, as on the pages.

    Raises:
        NotAllowedError: there are accounts, and none has this name, or its role does not permit this; or there are
            none, and this is no person's name.
        SignInRefusedError: name and password do not belong together, or the account is not in use.
    """
    accounts = {account.account: account.role for account in people.accounts.all()}
    if not accounts:
        return Identity(_claimed(typed), "", "claimed")
    name = plain_name(typed)
    if name not in accounts:
        raise NotAllowedError(
            f"only accounts act here, and {typed!r} is none",
            where="name",
            remedy="Give the name of your account with --operator; an administrator makes one on the page Accounts",
        )
    people.check_password(name, password())
    role = accounts[name]
    permitted = [each for each in ROLES if may(each, permission)]
    if role not in permitted:
        raise NotAllowedError(
            f"{name} is {role} and may not do this",
            where=permission,
            remedy=f"Call somebody whose role is {' or '.join(permitted)}",
        )
    return Identity(name, role, "password")


def who_pauses(people: People, typed: str) -> Identity:
    """Identify whoever pauses a run, without a password and whatever the name: pausing is always safe.

    Where there are accounts, the record says that the name was only claimed.
    """
    name = cleaned_name(typed)
    return Identity(f"claimed:{name}" if people.accounts.all() else name, "", "claimed")


def identify(
    people: People,
    typed: str,
    role: str,
    secret: Callable[[], str],
    known_by: KnownBy = "password",
    origin: SecretOrigin = TERMINAL,
) -> Identity:
    """Identify the person of this name in this role.

    Args:
        people: accounts of the data folder.
        typed: the name as typed.
        role: the role that the action needs.
        secret: asks for the secret; not called on a site without accounts, where the name is a claim.
        known_by: the kind of secret: the account's password, PIN or badge.
        origin: the place where the secret is typed.

    Raises:
        SignInRefusedError: name and secret do not belong together.
        NotAllowedError: no name was given, or none that a person can have, or the account has another role.
    """
    if not typed.strip():
        raise NotAllowedError("a name is needed", where="name", remedy=f"Give the name of the {role}")
    if not people.accounts.all():
        return Identity(_claimed(typed), role, "claimed")
    name = plain_name(typed)
    people.check_secret(name, known_by, secret(), origin)
    account = people.accounts.get(name)
    if account.role != role:
        raise NotAllowedError(f"{name} is {account.role}; this needs a {role}", where="role", remedy=f"Call a {role}")
    return Identity(name, account.role, known_by)


def _claimed(typed: str) -> str:
    """Return a name on a site without accounts. Raises NotAllowedError if it is no person's name."""
    try:
        return person_name(typed)
    except ConfigurationError as error:
        raise NotAllowedError(error.what, where=error.where, remedy=error.remedy) from error
