"""Passwords, PINs and random tokens: what is acceptable, and what of them is stored."""

from __future__ import annotations

import hashlib
import re
import secrets
import unicodedata
from functools import cached_property

from argon2 import PasswordHasher
from argon2.exceptions import VerifyMismatchError

from service.people.errors import AccountError

PASSWORD_MIN = 10
PASSWORD_MAX = 256
_PIN = re.compile(r"[0-9]{4,8}")
_BADGE = re.compile(r"[0-9A-F]{6,32}")


class Passwords:
    """Argon2id hashes (RFC 9106; the library's default parameters unless told otherwise)."""

    def __init__(self, hasher: PasswordHasher | None = None) -> None:
        self._hasher = hasher or PasswordHasher()

    def hash(self, secret: str) -> str:
        """The hash to store, salt and parameters included."""
        return self._hasher.hash(_same_form(secret))

    def matches(self, stored: str, secret: str) -> bool:
        """Whether a secret belongs to a stored hash; takes as long when there is none ("")."""
        decoy = self._decoy
        try:
            self._hasher.verify(stored or decoy, _same_form(secret))
        except VerifyMismatchError:
            return False
        return bool(stored)

    def is_outdated(self, stored: str) -> bool:
        """Whether a stored hash was made with other parameters than today's."""
        return self._hasher.check_needs_rehash(stored)

    @cached_property
    def _decoy(self) -> str:
        return self._hasher.hash(secrets.token_urlsafe(16))


def _same_form(secret: str) -> str:
    # Keyboards differ in how they send the same letter: é as one character or as two.
    return unicodedata.normalize("NFKC", secret)


def require_password(password: str, account: str) -> None:
    """Raises AccountError for a password that is too short, too long, or the account's name."""
    if not PASSWORD_MIN <= len(password) <= PASSWORD_MAX:
        raise AccountError(
            "the password is too short or too long",
            where="password",
            remedy=f"Use {PASSWORD_MIN} to {PASSWORD_MAX} characters; a few unrelated words are good",
        )
    if password.strip().lower() == account:
        raise AccountError("the password is the account's name", where="password", remedy="Choose another one")


def require_pin(pin: str) -> None:
    """Raises AccountError for a PIN that is not 4 to 8 digits."""
    if not _PIN.fullmatch(pin):
        raise AccountError("the PIN is not 4 to 8 digits", where="pin", remedy="Use 4 to 8 digits")


def plain_badge(typed: str) -> str:
    """What a badge reader has typed, as it is hashed. Raises AccountError for what cannot be a badge."""
    plain = typed.strip().upper()
    if not _BADGE.fullmatch(plain):
        raise AccountError(
            "this is no badge: 6 to 32 digits or letters A to F are",
            where="badge",
            remedy="Hold the badge before the reader while the field has the focus",
        )
    return plain


def new_token() -> str:
    """256 random bits for a cookie or a link."""
    return secrets.token_urlsafe(32)


def token_sha256(token: str) -> str:
    """What is stored of a token."""
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).hexdigest()
