"""Content-addressed files, and the rows that record the origin of each."""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, cast

from sqlalchemy import Connection, Row, bindparam, insert, select

from service.core.errors import IntegrityError, StoreError
from service.core.records.base import ArtefactRef
from service.core.records.events import Event
from service.core.words import storable_data
from service.store.database.engine import RESTORE
from service.store.database.tables import artefacts
from service.store.durable_effects import Files, IdSource
from service.store.events import canonical_parsed, references, sha256_text
from service.store.records import Artefact, NewArtefact

CHUNK_BYTES = 1 << 20
TEMPORARY = "tmp"  # beside the shards on the same file system, so that a rename is atomic
_SHA256 = re.compile(r"[0-9a-f]{64}")
_INSERT = insert(artefacts)  # like the next, put together once for all images
_RECORDED = (
    select(artefacts.c.seq)
    .where(
        artefacts.c.sha256 == bindparam("hash"),
        artefacts.c.run_id == bindparam("run"),
        artefacts.c.size_bytes == bindparam("size"),
    )
    .limit(1)
)


def relative_path(sha256: str) -> Path:
    """Return the path ab/abcdef… below the artefact folder. Raises StoreError if `sha256` is not a SHA-256."""
    if not _SHA256.fullmatch(sha256):
        raise StoreError(
            f"{sha256!r} is not a SHA-256", remedy="Use the reference that put_file or put_bytes returned"
        )
    return Path(sha256[:2], sha256)


def chunks_of(path: Path) -> Iterator[bytes]:
    """Yield the bytes of a file, one megabyte at a time. Raises OSError."""
    with path.open("rb") as handle:
        while chunk := handle.read(CHUNK_BYTES):
            yield chunk


def hash_file(path: Path) -> tuple[str, int]:
    """Return the SHA-256 and size in bytes of a file. Raises OSError."""
    meter = Meter(chunks_of(path))
    for _ in meter:
        pass
    return meter.sha256, meter.size


class Meter:
    """Hashes and counts the bytes that pass through."""

    def __init__(self, chunks: Iterable[bytes]) -> None:
        self._chunks = chunks
        self._hash = hashlib.sha256()
        self.size = 0

    def __iter__(self) -> Iterator[bytes]:
        for chunk in self._chunks:
            self._hash.update(chunk)
            self.size += len(chunk)
            yield chunk

    @property
    def sha256(self) -> str:
        """SHA-256 of what has passed."""
        return self._hash.hexdigest()


class ArtefactFiles:
    """The folder of content-addressed files, each written once and read-only."""

    def __init__(self, folder: Path, files: Files, ids: IdSource) -> None:
        self._folder = folder
        self._files = files
        self._ids = ids
        self._durable_shards: set[Path] = set()

    @property
    def folder(self) -> Path:
        """The folder that holds the shards."""
        return self._folder

    def prepare(self) -> None:
        """Make the folders of a new store. Raises OSError."""
        for directory in (self._folder, self._folder / TEMPORARY):
            self._files.make_directory(directory)
            self._files.sync_directory(directory.parent)

    def put(self, chunks: Iterable[bytes], *, expected_sha256: str | None = None) -> tuple[str, int]:
        """Store bytes durably under their SHA-256, unless already stored. Returns hash and size in bytes.

        A crash is harmless because of the order: data, mode, fsync, rename, fsync of the directory, later the row.

        Raises:
            StoreError: the bytes do not have the expected hash, or the disk is full.
            IntegrityError: the file exists with other content.
        """
        temporary = self._folder / TEMPORARY / f"{self._ids.new_token()}.part"
        meter = Meter(chunks)
        with _put_errors():
            try:
                self._files.write(temporary, meter)
                _check_arrival(meter.sha256, expected_sha256)
                target = self._folder / relative_path(meter.sha256)
                self._make_shard(target.parent)
                if self._made_young(target):
                    self._check_same(target, meter.sha256)
                    self._files.remove(temporary)
                else:
                    self._files.make_read_only(temporary)
                    self._files.sync_file(temporary)
                    self._files.rename(temporary, target)
            except (OSError, StoreError):
                self._files.remove(temporary)
                raise
            # Also for an existing file: the process that renamed it may have died before syncing.
            self._files.sync_directory(target.parent)
        return meter.sha256, meter.size

    def _make_shard(self, shard: Path) -> None:
        if shard not in self._durable_shards:
            self._files.make_directory(shard)
            self._files.sync_directory(shard.parent)
            self._durable_shards.add(shard)

    def _made_young(self, target: Path) -> bool:
        """Touch the file, so that it is not removed as an old leftover. Returns whether it exists."""
        with _locked(self._folder, fcntl.LOCK_SH):
            try:
                os.utime(target)
            except (FileNotFoundError, PermissionError):  # another user's file is replaced by the same bytes
                return False
        return True

    def _check_same(self, target: Path, sha256: str) -> None:
        present, _size = hash_file(target)
        if present != sha256:
            raise IntegrityError(
                f"a stored file was altered: its content is {present}",
                where=str(target),
                remedy="Run `orthocapture audit verify`; restore the file from a copy",
            )

    def path(self, sha256: str) -> Path:
        """Return the file of a recorded artefact. Raises IntegrityError if it is missing."""
        path = self._folder / relative_path(sha256)
        if not path.is_file():
            raise IntegrityError(
                "a stored file is missing", where=str(path), remedy="Restore it from a copy of the data"
            )
        return path

    def verified_path(self, sha256: str) -> Path:
        """Return the file of a recorded artefact, hashed again. Raises IntegrityError if it is missing or altered."""
        path = self.path(sha256)
        self._check_same(path, sha256)
        return path


def alone_with(folder: Path) -> AbstractContextManager[None]:
    """Hold the exclusive lock of an artefact folder, so that no process reuses a stored file. Raises OSError."""
    return _locked(folder, fcntl.LOCK_EX)


@contextmanager
def _locked(folder: Path, how: int) -> Generator[None]:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, how)
        yield
    finally:
        os.close(descriptor)


def _check_arrival(sha256: str, expected_sha256: str | None) -> None:
    if expected_sha256 is not None and sha256 != expected_sha256:
        raise StoreError(
            f"the file changed in transfer: SHA-256 {sha256} instead of {expected_sha256}",
            where="artefacts",
            remedy="Fetch it from the device again",
        )


@contextmanager
def _put_errors() -> Generator[None]:
    try:
        yield
    except OSError as error:
        raise StoreError(
            f"a file could not be stored: {error.strerror or error}",
            where=str(error.filename or ""),
            remedy="Check free space and permissions; nothing of it was recorded, and what was before is safe",
        ) from error


def record_sha256(event_sha256: str, fields: dict[str, Any]) -> str:
    """Return the SHA-256 that binds an artefact's row to its event; the field `record_sha256` is ignored."""
    named = {name: value for name, value in fields.items() if name != "record_sha256"}
    return sha256_text(canonical_parsed(named | {"event_sha256": event_sha256}))


def insert_artefacts(
    connection: Connection, folder: ArtefactFiles, events: Sequence[Event], new: Sequence[NewArtefact]
) -> None:
    """Write the rows of new artefacts beside the events that refer to them, in the caller's transaction.

    Raises:
        StoreError: no event refers to an artefact, or an event refers to an artefact without a row.
        IntegrityError: the file is missing or has another size.
    """
    waiting = list(new)
    for event in events:
        named = references(event.payload.model_dump(mode="python"))
        mine = [artefact for artefact in waiting if artefact.ref in named]
        waiting = [artefact for artefact in waiting if artefact.ref not in named]
        for position, artefact in enumerate(mine):
            _insert(connection, folder, event, position, artefact)
        for ref in named:
            _require_row(connection, event, ref)
    if waiting:
        raise StoreError(
            f"no event of this record refers to artefact {waiting[0].ref.sha256} ({waiting[0].ref.original_name})",
            remedy="Name its ArtefactRef in the payload, so that the chain covers it",
        )


def _insert(
    connection: Connection, folder: ArtefactFiles, event: Event, position: int, artefact: NewArtefact
) -> None:
    path = folder.path(artefact.ref.sha256)
    size = path.stat().st_size
    if size != artefact.ref.size_bytes:
        raise IntegrityError(
            f"the file has {size} bytes instead of {artefact.ref.size_bytes}", where=str(path), remedy=RESTORE
        )
    origin: dict[str, Any] = {
        "run_id": event.run_id,
        "seq": event.seq,
        "position": position,
        **artefact.ref.model_dump(),
        "device": artefact.device,
        "step": artefact.step,
        "attempt": artefact.attempt,
        "viewpoint": artefact.viewpoint,
        "who": event.actor if artefact.who is None else artefact.who,
        "at_utc": event.at_utc if artefact.at_utc is None else artefact.at_utc,
        "monotonic_s": float(event.monotonic_s if artefact.monotonic_s is None else artefact.monotonic_s),
    }
    fields = cast("dict[str, Any]", storable_data(origin))
    digest = record_sha256(event.sha256, fields)
    connection.execute(_INSERT, fields | {"record_sha256": digest})


def _require_row(connection: Connection, event: Event, ref: ArtefactRef) -> None:
    wanted = {"run": event.run_id, "hash": ref.sha256, "size": ref.size_bytes}
    if connection.execute(_RECORDED, wanted).first() is None:
        raise StoreError(
            f"{event.payload.kind} refers to an artefact that this run has not recorded: {ref.original_name}",
            where=ref.sha256,
            remedy="Hand it to the same call as NewArtefact",
        )


def read_artefacts(connection: Connection, run_id: str) -> list[Artefact]:
    """Return all artefact rows of a run, in the order of its events."""
    rows = connection.execute(
        select(artefacts).where(artefacts.c.run_id == run_id).order_by(artefacts.c.seq, artefacts.c.position)
    )
    return [to_artefact(row) for row in rows]


def to_artefact(row: Row[Any]) -> Artefact:
    """Return a row of `artefacts` as an Artefact."""
    return Artefact(
        run_id=row.run_id,
        seq=row.seq,
        position=row.position,
        ref=ArtefactRef(
            sha256=row.sha256,
            kind=row.kind,
            media_type=row.media_type,
            size_bytes=row.size_bytes,
            original_name=row.original_name,
        ),
        device=row.device,
        step=row.step,
        attempt=row.attempt,
        viewpoint=row.viewpoint,
        who=row.who,
        at_utc=row.at_utc,
        monotonic_s=row.monotonic_s,
        record_sha256=row.record_sha256,
    )


def open_folder(data_dir: Path, files: Files, ids: IdSource) -> ArtefactFiles:
    """Return the files below a data folder; folders that do not exist are made.

    Raises StoreError if they cannot be.
    """
    folder = ArtefactFiles(data_dir / "artefacts", files, ids)
    try:
        for directory in (*reversed(data_dir.absolute().parents), data_dir.absolute()):
            if not directory.exists():
                files.make_directory(directory, private=directory == data_dir.absolute())
                files.sync_directory(directory.parent)
        folder.prepare()
    except OSError as error:
        raise StoreError(
            f"the data folder cannot be made: {error.strerror or error}",
            where=str(error.filename or data_dir),
            remedy="Check the path and its permissions, or choose another folder with --data DIR",
        ) from error
    return folder
