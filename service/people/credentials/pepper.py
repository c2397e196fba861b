"""The key to which PINs and badges are bound: DIR/keys/pepper, which is not in the database."""

from __future__ import annotations

import hashlib
import hmac
import secrets
from functools import cached_property

from service.core.errors import StoreError
from service.store.access import KEYS, PEPPER
from service.store.store import Store

_BYTES = 32


class Pepper:
    """The key of one data folder, made at first use. Its methods raise StoreError if it cannot be read or made."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._path = store.database_path.parent / KEYS / PEPPER

    def name(self) -> str:
        """A name for the key, which does not tell the key."""
        return hashlib.sha256(b"name of " + self._key).hexdigest()[:16]

    def bind(self, secret: str) -> str:
        """The keyed hash (HMAC, RFC 2104) of a secret, hexadecimal."""
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
