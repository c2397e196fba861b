"""Streams an exported folder as a zip file, without keeping the zip file on disk or in memory."""

from __future__ import annotations

import hashlib
import io
import os
import zipfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from service.core.errors import IntegrityError
from service.dataset.export_folder import SUMS

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_OLDEST = (1980, 1, 1, 0, 0, 0)  # the earliest time in zip; the files state their own dates
_CHUNK = 1 << 20
_TEXT = frozenset({".json", ".txt", ".csv", ".md", ".xml", ".ply", ".py"})  # others are compressed already


class _Sent(io.RawIOBase):
    """A write-only file for zipfile; `take` removes and returns the bytes written since the last call."""

    def __init__(self) -> None:
        self._kept = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, data: ReadableBuffer, /) -> int:
        view = memoryview(data).cast("B")
        self._kept += view
        return len(view)

    def take(self) -> bytes:
        taken = bytes(self._kept)
        self._kept.clear()
        return taken


def zip_chunks(folder: Path, sums_sha256: str) -> Iterator[bytes]:
    """The bytes of the zip file: the files that SHA256SUMS lists, and SHA256SUMS last.

    Args:
        folder: an exported data set.
        sums_sha256: recorded hash of its list of checksums.

    Raises:
        IntegrityError: the list is not the recorded one, or a file is not the listed one: the transfer breaks off.
    """
    sums = (folder / SUMS).read_bytes()
    if hashlib.sha256(sums).hexdigest() != sums_sha256:
        raise _altered(SUMS)
    sent = _Sent()
    with zipfile.ZipFile(sent, "w", allowZip64=True) as archive:
        for line in sums.decode().splitlines():
            sha256, _, name = line.partition("  ")
            yield from _entry(archive, sent, folder, name, sha256)
        with archive.open(_info(f"{folder.name}/{SUMS}"), "w") as entry:
            entry.write(sums)
    yield sent.take()


def _entry(archive: zipfile.ZipFile, sent: _Sent, folder: Path, name: str, sha256: str) -> Iterator[bytes]:
    """One file, read without following links."""
    inside = PurePosixPath(name)
    if inside.is_absolute() or ".." in inside.parts:
        raise _altered(name)
    digest = hashlib.sha256()
    try:
        opened = os.open(folder / inside, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError as error:
        raise _altered(name) from error
    with (
        os.fdopen(opened, "rb") as file,
        archive.open(_info(f"{folder.name}/{name}"), "w", force_zip64=True) as entry,
    ):
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
            entry.write(chunk)
            yield sent.take()
    if digest.hexdigest() != sha256:
        raise _altered(name)


def _info(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name, date_time=_OLDEST)
    info.compress_type = zipfile.ZIP_DEFLATED if PurePosixPath(name).suffix in _TEXT else zipfile.ZIP_STORED
    info.external_attr = 0o100644 << 16
    return info


def _altered(name: str) -> IntegrityError:
    return IntegrityError("a file of the export is not as it was written", where=name, remedy="Export again")
