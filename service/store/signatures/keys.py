"""Private keys as files DIR/keys/KEY_ID.pem, which no other user can read at any moment."""

from __future__ import annotations

from pathlib import Path

from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_pem_private_key,
)

from service.store.access import KEYS
from service.store.durable_effects import Files
from service.store.errors import SigningKeyError
from service.store.signatures.checkpoints import key_fingerprint

_SUFFIX, _PART = ".pem", ".part"
_REMEDY = "Restore the folder keys/ from a copy, or make a new key with `orthocapture audit rotate-key --lost`"


def public_bytes(key: Ed25519PrivateKey) -> bytes:
    """The 32 raw bytes of the public key (RFC 8032)."""
    return key.public_key().public_bytes(Encoding.Raw, PublicFormat.Raw)


class KeyFolder:
    """The private keys of one data folder. Callers hold the database's write lock, so no two processes interfere."""

    def __init__(self, data_dir: Path, files: Files) -> None:
        self._folder = data_dir / KEYS
        self._files = files

    def make(self) -> Ed25519PrivateKey:
        """Make a new key, durable on return. Raises SigningKeyError.

        A crash is harmless because of the order: write and sync a part file, rename it, sync the folder; the event
        comes later.
        """
        key = Ed25519PrivateKey.generate()
        pem = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        target = self._path(key_fingerprint(public_bytes(key)))
        try:
            self._prepare()
            part = target.with_suffix(_PART)
            self._files.write(part, [pem], private=True)
            self._files.sync_file(part)
            self._files.rename(part, target)
            self._files.sync_directory(self._folder)
        except OSError as error:
            raise SigningKeyError(
                f"the signing key cannot be stored: {error.strerror or error}",
                where=str(error.filename or self._folder),
                remedy="Check free space and the permissions of the data folder",
            ) from error
        return key

    def load(self, key_id: str) -> Ed25519PrivateKey:
        """The private key with this fingerprint.

        Raises SigningKeyError if the file is missing, damaged, readable by others or holds another key.
        """
        path = self._path(key_id)
        try:
            for checked in (self._folder, path):
                if checked.stat().st_mode & 0o077:
                    raise SigningKeyError(
                        "the signing key can be read by other users of this machine",
                        where=str(checked),
                        remedy=f"Chmod go-rwx {checked}; if somebody may have read it: orthocapture audit rotate-key",
                    )
            key = load_pem_private_key(path.read_bytes(), password=None)
        except FileNotFoundError as error:
            raise SigningKeyError("the signing key is missing", where=str(path), remedy=_REMEDY) from error
        except PermissionError as error:
            raise SigningKeyError(
                "the signing key is another account's, which alone signs in this data folder",
                where=str(path),
                remedy="Run this as the account that owns the data folder; a worker may be another's",
            ) from error
        except (OSError, ValueError, TypeError, UnsupportedAlgorithm) as error:
            raise SigningKeyError(
                f"the signing key cannot be read: {error}", where=str(path), remedy=_REMEDY
            ) from error
        if not isinstance(key, Ed25519PrivateKey) or key_fingerprint(public_bytes(key)) != key_id:
            raise SigningKeyError("the file holds another key", where=str(path), remedy=_REMEDY)
        return key

    def present(self) -> list[str]:
        """Fingerprints of the complete key files, sorted."""
        return sorted(path.stem for path in self._folder.glob(f"*{_SUFFIX}")) if self._folder.is_dir() else []

    def destroy_all_but(self, key_id: str) -> None:
        """Remove all other keys and partly written key files. Raises SigningKeyError."""
        try:
            others = [p for p in self._folder.iterdir() if p.suffix in (_SUFFIX, _PART) and p != self._path(key_id)]
            for path in others:
                self._files.remove(path)
            if others:
                self._files.sync_directory(self._folder)
        except OSError as error:
            raise SigningKeyError(
                f"an old signing key cannot be destroyed: {error.strerror or error}",
                where=str(self._folder),
                remedy="Delete every other file of this folder by hand",
            ) from error

    def _path(self, key_id: str) -> Path:
        return self._folder / f"{key_id}{_SUFFIX}"

    def _prepare(self) -> None:
        if not self._folder.exists():
            self._files.make_directory(self._folder, private=True)
            self._files.sync_directory(self._folder.parent)
