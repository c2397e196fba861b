"""Credentials: which are acceptable, what is stored of them, and how failed tries make people wait."""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import unicodedata
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import cached_property
from math import inf
from typing import Any

from argon2 import PasswordHasher
from argon2.exceptions import VerifyMismatchError
from sqlalchemy import ColumnElement, Row, select

from service.core.errors import StoreError
from service.core.records.events import SignInRecorded
from service.people.person import SERVICE, AccountError, Person
from service.store.data_folder import KEYS, PEPPER
from service.store.database.tables import event_facets, event_index, events
from service.store.event_index import facet_value
from service.store.events import to_event
from service.store.records import SITE
from service.store.store import Store

PASSWORD_MIN = 10
PASSWORD_MAX = 256
_PIN = re.compile(r"[0-9]{4,8}")
_BOUND = "hmac-sha256:"  # before the name of the key, a colon, and the argon2id hash of the keyed hash
_BADGE = re.compile(r"[0-9A-F]{6,32}")


class Passwords:
    """Argon2id hashes (RFC 9106), by default with the library's parameters."""

    def __init__(self, hasher: PasswordHasher | None = None) -> None:
        self._hasher = hasher or PasswordHasher()

    def hash(self, secret: str) -> str:
        """Return the hash to store, salt and parameters included."""
        return self._hasher.hash(_same_form(secret))

    def matches(self, stored: str, secret: str) -> bool:
        """Return whether a secret belongs to a stored hash; takes the same time if nothing is stored ("")."""
        if not stored:
            self.hash(secret)  # for nothing: to verify is to hash once, and to compare
            return False
        try:
            return self._hasher.verify(stored, _same_form(secret))
        except VerifyMismatchError:
            return False

    def is_outdated(self, stored: str) -> bool:
        """Return whether a stored hash was made with parameters other than the present ones."""
        return self._hasher.check_needs_rehash(stored)


class ShortSecrets:
    """Hashes of PINs and badges, which whoever has a hash could guess: bound to a key outside the database.

    A copy of the database alone, such as a backup without keys, gives nobody a PIN. Hashes of earlier versions are
    accepted until they are renewed.
    """

    def __init__(self, passwords: Passwords, pepper: Pepper) -> None:
        self._passwords = passwords
        self._pepper = pepper

    def hash(self, secret: str) -> str:
        """Return the hash to store, with the name of the key to which it is bound.

        Raises StoreError without that key.
        """
        return f"{self._bound()}{self._passwords.hash(self._pepper.bind(_same_form(secret)))}"

    def matches(self, stored: str, secret: str) -> bool:
        """Return whether a secret belongs to a stored hash; takes the same time if it cannot. Raises StoreError."""
        if not stored.startswith(_BOUND):
            return self._passwords.matches(stored, secret)
        mine = "" if self.is_lost(stored) else stored.removeprefix(self._bound())
        return self._passwords.matches(mine, self._pepper.bind(_same_form(secret)))

    def is_outdated(self, stored: str) -> bool:
        """Return whether a stored hash is not bound to the key, or was made with other parameters than now."""
        return not stored.startswith(_BOUND) or self._passwords.is_outdated(stored.rpartition(":")[2])

    def is_lost(self, stored: str) -> bool:
        """Return whether a hash is bound to a key that is not here any more, so that nothing matches it."""
        return stored.startswith(_BOUND) and not stored.startswith(self._bound())

    def _bound(self) -> str:
        return f"{_BOUND}{self._pepper.name()}:"


def _same_form(secret: str) -> str:
    # Keyboards may send the same letter differently: é as one character or as two.
    return unicodedata.normalize("NFKC", secret)


def require_password(password: str, account: str) -> None:
    """Raise AccountError if a password is too short, too long, or the account's name."""
    if not PASSWORD_MIN <= len(password) <= PASSWORD_MAX:
        raise AccountError(
            "the password is too short or too long",
            where="password",
            remedy=f"Use {PASSWORD_MIN} to {PASSWORD_MAX} characters; a few unrelated words are good",
        )
    if password.strip().lower() == account:
        raise AccountError("the password is the account's name", where="password", remedy="Choose another one")


def require_pin(pin: str) -> None:
    """Raise AccountError unless a PIN has 4 to 8 digits."""
    if not _PIN.fullmatch(pin):
        raise AccountError("the PIN is not 4 to 8 digits", where="pin", remedy="Use 4 to 8 digits")


def plain_badge(typed: str) -> str:
    """Return a badge's code in the format that is hashed. Raises AccountError if it cannot be a badge's."""
    plain = typed.strip().upper()
    if not _BADGE.fullmatch(plain):
        raise AccountError(
            "this is not a badge: a badge has 6 to 32 digits or letters A to F",
            where="badge",
            remedy="Hold the badge to the reader while the field has the focus",
        )
    return plain


def new_token() -> str:
    """Return a token of 256 random bits for a cookie or a link."""
    return secrets.token_urlsafe(32)


def token_sha256(token: str) -> str:
    """Return the SHA-256 (hexadecimal) of a token, which is stored instead of it."""
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).hexdigest()


_BYTES = 32


class Pepper:
    """The key of one data folder, made at first use. Its methods raise StoreError if it cannot be read or made."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._path = store.database_path.parent / KEYS / PEPPER

    def name(self) -> str:
        """Return a name for the key, which does not reveal the key."""
        return hashlib.sha256(b"name of " + self._key).hexdigest()[:16]

    def bind(self, secret: str) -> str:
        """Return the keyed hash (HMAC, RFC 2104) of a secret, hexadecimal."""
        return hmac.digest(self._key, secret.encode("utf-8", "surrogatepass"), "sha256").hex()

    @cached_property
    def _key(self) -> bytes:
        try:
            if not self._path.exists():
                self._make()
            key = self._path.read_bytes()
        except OSError as error:
            raise StoreError(
                f"the key of the PINs cannot be used: {error.strerror}",
                where=str(self._path),
                remedy="Run this as the account to which the data folder belongs; without PIN and badge, give the "
                "password",
            ) from error
        if len(key) != _BYTES:
            raise StoreError(
                "the key of the PINs is damaged",
                where=str(self._path),
                remedy="Restore it from a copy, or delete it: people then sign in with passwords and set new PINs",
            )
        return key

    def _make(self) -> None:
        """Make the key, durable on return. The database's write lock keeps two processes from making two."""
        files, folder = self._store.files, self._path.parent
        with self._store.database.writing():
            if self._path.exists():
                return
            files.make_directory(folder, private=True)
            files.sync_directory(folder.parent)
            part = self._path.with_suffix(".part")
            files.remove(part)
            files.write(part, [secrets.token_bytes(_BYTES)], private=True)
            files.sync_file(part)
            files.rename(part, self._path)
            files.sync_directory(folder)


# Failed tries: where a secret was typed, how many were wrong there, and how long one has to wait there.
#
# Strangers and people whom an account knows are counted apart, so that nobody can shut a person out by guessing.
# Whoever is signed in, at a terminal of the machine, or at an address from which the account has signed in, has a
# count of their own. The counts are those of the site's chain, so that a restart does not forget them.


FREE_FAILURES = 5  # wrong passwords in a row before one waits; wrong PINs before a sign-in ends
FIRST_WAIT_S = 30.0
LONGEST_WAIT_S = 900.0
REMEMBERED_S = 6 * 3600.0  # how long a wrong password of a known person counts
_PLACE = (event_index.c.run_id == events.c.run_id) & (event_index.c.seq == events.c.seq)
_OF_SITE = select(events).join(event_index, _PLACE).where(event_index.c.run_id == SITE)
_AT_ONCE = 200  # rows


def _has(name: str, value: str) -> ColumnElement[bool]:
    """Return the condition that an event of the index has this facet."""
    facet = event_facets.alias()
    return (
        select(facet.c.seq)
        .where(
            facet.c.run_id == event_index.c.run_id,
            facet.c.seq == event_index.c.seq,
            facet.c.name == name,
            facet.c.value == facet_value(value),
        )
        .correlate(event_index)
        .exists()
    )


def wait_after_s(failures: int) -> float:
    """Return the seconds to wait after this many wrong passwords in a row."""
    over = failures - FREE_FAILURES
    return 0.0 if over < 0 else min(FIRST_WAIT_S * 2.0 ** min(over, 10), LONGEST_WAIT_S)


@dataclass(frozen=True, slots=True)
class SecretOrigin:
    """The place where a secret is typed: a browser's address, a screen that is signed in, or a terminal."""

    address: str = ""  # address of the browser that signs in
    screen: str = ""
    by: str = ""  # the account that is signed in on the screen


TERMINAL = SecretOrigin(address="terminal")


def on_screen_of(person: Person) -> SecretOrigin:
    """Return the screen on which a person is signed in."""
    return SecretOrigin(screen=person.screen, by=person.account)


def _counted_at(account: str, origin: SecretOrigin) -> tuple[str, str, str]:
    """Return the key of the tries that are counted together.

    For another's secret the key is who typed it, so that a new sign-in starts no new count.
    """
    if not origin.by:
        return account, "address", origin.address
    return (account, "screen", origin.screen) if origin.by == account else (account, "by", origin.by)


class KnownTries:
    """Wrong passwords, PINs and badges of people whom their account knows, since the last right password there."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def knows(self, account: str, origin: SecretOrigin) -> bool:
        """Return whether the origin is a screen, a terminal, or an address from which the account has signed in."""
        return bool(origin.by) or origin == TERMINAL or (account, origin.address) in self._addresses

    def wait_s(self, account: str, origin: SecretOrigin) -> float:
        """Return the seconds to wait before the next try; 0 for none."""
        return self._wait_s(_counted_at(account, origin))

    def longest_wait_s(self, account: str) -> float:
        """Return the longest wait at any of the account's known origins."""
        return max((self._wait_s(counted) for counted in tuple(self._failed) if counted[0] == account), default=0.0)

    def failed(self, account: str, origin: SecretOrigin) -> None:
        """Count a wrong secret."""
        at_s = self._store.clock.monotonic_s()
        self._failed.setdefault(_counted_at(account, origin), _new_count()).append(at_s)

    def succeeded(self, account: str, origin: SecretOrigin) -> None:
        """Start the count again after the right password; a sign-in makes its address known."""
        self._failed.pop(_counted_at(account, origin), None)
        if origin.address and not origin.by:
            self._addresses.add((account, origin.address))

    def _wait_s(self, counted: tuple[str, str, str]) -> float:
        now, failed = self._store.clock.monotonic_s(), self._failed.get(counted)
        while failed and now - failed[0] >= REMEMBERED_S:
            failed.popleft()
        left_s = failed[-1] + wait_after_s(len(failed)) - now if failed else 0.0
        if left_s > 0 and self._ended_after(counted[0], failed[-1] if failed else now):
            self._failed.pop(counted, None)
            return 0.0
        return max(0.0, left_s)

    def _ended_after(self, account: str, monotonic_s: float) -> bool:
        """Return whether an administrator has ended the account's waits since; perhaps from another process."""
        ended = (
            _OF_SITE.where(
                event_index.c.kind == "account_changed", _has("field", "lock_out"), _has("account", account)
            )
            .order_by(events.c.seq.desc())
            .limit(1)
        )
        with self._store.database.reading() as connection:
            row = connection.execute(ended).first()
        return row is not None and _age_s(self._store, row) <= self._store.clock.monotonic_s() - monotonic_s

    @cached_property
    def _addresses(self) -> set[tuple[str, str]]:
        """(account, address) of every sign-in that succeeded."""
        account, address = event_facets.alias(), event_facets.alias()
        signed_in = (
            select(account.c.value, address.c.value)
            .distinct()
            .join(event_index, (event_index.c.run_id == account.c.run_id) & (event_index.c.seq == account.c.seq))
            .join(address, (address.c.run_id == account.c.run_id) & (address.c.seq == account.c.seq))
            .where(
                account.c.run_id == SITE,
                account.c.name == "account",
                address.c.name == "address",
                event_index.c.kind == "sign_in_recorded",
                event_index.c.actor != SERVICE,
                _has("outcome", "signed_in"),
            )
        )
        with self._store.database.reading() as connection:
            return {(str(one), str(other)) for one, other in connection.execute(signed_in) if other}

    @cached_property
    def _failed(self) -> dict[tuple[str, str, str], deque[float]]:
        """Monotonic times of the tries that count, as the chain has them when this process first asks."""
        now = self._store.clock.monotonic_s()
        counted: dict[tuple[str, str, str], deque[float]] = {}
        for row, tried, age_s in reversed(list(_recent(self._store, REMEMBERED_S))):
            by = "" if row.actor == SERVICE or not tried.screen else str(row.actor)
            origin = SecretOrigin(tried.address, tried.screen if by else "", by)
            if tried.outcome == "signed_in":
                counted.pop((tried.account, "address", tried.address), None)
            elif _is_wrong(tried) and (by or tried.address) and self.knows(tried.account, origin):
                counted.setdefault(_counted_at(tried.account, origin), _new_count()).append(now - age_s)
        return counted


def failed_tries(store: Store, window_s: float) -> list[tuple[str, float]]:
    """Return (address, age in s) of every failed try at a sign-in within the last `window_s` seconds, oldest first.

    A try that seems to be in the future, because the clock was set back, counts as made now. Since the first start of
    the service in the present boot, both clocks must say that a try is old. Raises IntegrityError.
    """
    tries = [(tried.address, age_s) for _row, tried, age_s in _recent(store, window_s) if _is_try(tried)]
    return tries[::-1]


def _recent(store: Store, window_s: float) -> Iterator[tuple[Row[Any], SignInRecorded, float]]:
    """Yield row, payload and age of recorded sign-ins within the last `window_s` seconds, newest first."""
    since = _first_start(store)
    newest_first = _OF_SITE.where(event_index.c.kind == "sign_in_recorded").order_by(event_index.c.seq.desc())
    with (
        store.database.reading() as connection,
        connection.execution_options(yield_per=_AT_ONCE).execute(newest_first) as rows,
    ):
        for row in rows:
            age_s = _age_s(store, row, since)
            if age_s >= window_s:
                return
            payload = to_event(row).payload
            if isinstance(payload, SignInRecorded):
                yield row, payload, age_s


def _first_start(store: Store) -> float:
    """Return the number of the event of the service's first start in the present boot; infinity if there is none."""
    boot = store.clock.boot()
    if not boot:
        return inf
    start = _OF_SITE.where(event_index.c.kind == "service_started", _has("boot", boot))
    with store.database.reading() as connection:
        first = connection.execute(start.order_by(events.c.seq).limit(1)).first()
    return inf if first is None else float(first.seq)


def _age_s(store: Store, row: Row[Any], since: float | None = None) -> float:
    now, monotonic_s = store.clock.utc_now(), store.clock.monotonic_s()
    by_utc_s = (now - datetime.fromisoformat(row.at_utc)) / timedelta(seconds=1)
    same_boot = row.seq > (_first_start(store) if since is None else since)
    return max(0.0, min(by_utc_s, monotonic_s - row.monotonic_s) if same_boot else by_utc_s)


def _new_count() -> deque[float]:
    return deque(maxlen=100)


def _is_wrong(event: SignInRecorded) -> bool:
    """Return whether a secret was wrong and was counted; nothing is counted while somebody has to wait."""
    return event.outcome == "refused" and event.account != ""


def _is_try(event: SignInRecorded) -> bool:
    # Events without an address concern a PIN or a signature; that an address has to wait is not a try.
    refused = event.outcome == "refused" or (event.outcome == "locked_out" and event.account != "")
    return refused and event.address not in ("", TERMINAL.address)
