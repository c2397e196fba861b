"""Decides which passwords, PINs, badge codes and tokens are acceptable, and what is stored of them."""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import unicodedata
from functools import cached_property

from argon2 import PasswordHasher
from argon2.exceptions import VerifyMismatchError

from service.core.errors import StoreError
from service.people.person import AccountError
from service.store.data_folder import KEYS, PEPPER
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
