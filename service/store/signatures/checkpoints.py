"""Keeps checkpoints, with the exact bytes that are signed, and the private keys that sign them."""

from __future__ import annotations

import base64
import binascii
import hashlib
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_pem_private_key,
)
from sqlalchemy import Connection, Row, bindparam, insert, select

from service.store.data_folder import KEYS
from service.store.database.tables import artefacts, checkpoints, events, timestamps
from service.store.durable_effects import Files
from service.store.events import canonical, parse_canonical
from service.store.records import SITE, Checkpoint, SigningKeyError, Timestamp

PURPOSE = "orthocapture checkpoint v1"  # keeps a signature from being used for anything else
_COLUMNS = tuple(field.name for field in fields(Checkpoint))
_NEWEST = (  # put together once: every signature asks it several times
    select(checkpoints).where(checkpoints.c.run_id == bindparam("run")).order_by(checkpoints.c.seq.desc()).limit(1)
)


def statement(checkpoint: Checkpoint) -> bytes:
    """Return the bytes that are signed: RFC 8785 canonical JSON of all fields but the signature, with the purpose."""
    named = asdict(checkpoint)
    del named["signature"]
    return canonical(named | {"purpose": PURPOSE}).encode()


def key_fingerprint(public_key: bytes) -> str:
    """Return the SHA-256 (hexadecimal) of the 32 raw bytes of an Ed25519 public key, for people to compare."""
    return hashlib.sha256(public_key).hexdigest()


def signed_by(checkpoint: Checkpoint, public_key: bytes) -> bool:
    """Return whether this key (32 raw bytes) made the checkpoint's signature."""
    try:
        signature = base64.b64decode(checkpoint.signature, validate=True)
        Ed25519PublicKey.from_public_bytes(public_key).verify(signature, statement(checkpoint))
    except (InvalidSignature, binascii.Error, ValueError):
        return False
    return True


class RowsDigest:
    """Running SHA-256 over the `record_sha256` of a run's artefact rows, one per line, in the order of the events."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def add(self, record_sha256: str) -> None:
        """Add one more row."""
        self._hash.update(record_sha256.encode() + b"\n")

    def hexdigest(self) -> str:
        """Return the digest over the rows added so far."""
        return self._hash.hexdigest()


def artefacts_digest(connection: Connection, run_id: str) -> str:
    """Return the RowsDigest over all artefact rows of a run, in hexadecimal."""
    digest = RowsDigest()
    ordered = select(artefacts.c.record_sha256).where(artefacts.c.run_id == run_id)
    for record_sha256 in connection.execute(ordered.order_by(artefacts.c.seq, artefacts.c.position)).scalars():
        digest.add(record_sha256)
    return digest.hexdigest()


def insert_checkpoint(connection: Connection, checkpoint: Checkpoint) -> None:
    """Insert a checkpoint's row in the caller's transaction."""
    connection.execute(insert(checkpoints), asdict(checkpoint))


def last_checkpoint(connection: Connection, run_id: str) -> Checkpoint | None:
    """Return the newest checkpoint of a run, or None."""
    row = connection.execute(_NEWEST, {"run": run_id}).one_or_none()
    return None if row is None else to_checkpoint(row)


def read_checkpoints(connection: Connection, run_id: str) -> list[Checkpoint]:
    """Return all checkpoints of a run, oldest first."""
    found = select(checkpoints).where(checkpoints.c.run_id == run_id).order_by(checkpoints.c.seq)
    return [to_checkpoint(row) for row in connection.execute(found)]


def read_checkpoint(connection: Connection, run_id: str, seq: int) -> Checkpoint | None:
    """Return the checkpoint of one event, or None."""
    found = select(checkpoints).where(checkpoints.c.run_id == run_id, checkpoints.c.seq == seq)
    row = connection.execute(found).one_or_none()
    return None if row is None else to_checkpoint(row)


def read_every_checkpoint(connection: Connection) -> list[Checkpoint]:
    """Return the checkpoints of all chains, in the order in which they were made."""
    made = select(checkpoints).order_by(checkpoints.c.site_seq, checkpoints.c.run_id == SITE, checkpoints.c.seq)
    return [to_checkpoint(row) for row in connection.execute(made)]


def read_timestamps(connection: Connection, run_id: str) -> list[Timestamp]:
    """Return all time stamps on a run's checkpoints, oldest first."""
    found = select(timestamps).where(timestamps.c.run_id == run_id).order_by(timestamps.c.seq, timestamps.c.authority)
    return [Timestamp(row.run_id, row.seq, row.authority, row.at_utc, row.token) for row in connection.execute(found)]


def to_checkpoint(row: Row[Any]) -> Checkpoint:
    """Return a row of the table as a Checkpoint."""
    return Checkpoint(**{name: getattr(row, name) for name in _COLUMNS})


def read_key_changes(connection: Connection) -> list[tuple[int, dict[str, Any]]]:
    """Return (seq, payload as plain data) of every KeyChanged in the site's chain, oldest first.

    Raises ValueError.
    """
    found = select(events.c.seq, events.c.payload).where(events.c.run_id == SITE, events.c.kind == "key_changed")
    return [(row.seq, parse_canonical(row.payload)) for row in connection.execute(found.order_by(events.c.seq))]


_SUFFIX, _PART = ".pem", ".part"
_REMEDY = "Restore the folder keys/ from a copy, or make a new key with `orthocapture audit rotate-key --lost`"


def public_bytes(key: Ed25519PrivateKey) -> bytes:
    """Return the 32 raw bytes of the public key (RFC 8032)."""
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
        """Return the private key with this fingerprint.

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
        """Return fingerprints of the complete key files, sorted."""
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
