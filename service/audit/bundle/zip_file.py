"""A bundle's zip file: streamed and hashed while it is written; the same content gives the same bytes."""

from __future__ import annotations

import hashlib
import os
import stat
import zipfile
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from service.core.errors import DataError, StoreError
from service.store.durable_effects import DurableFiles

ZipTime = tuple[int, int, int, int, int, int]


@dataclass(frozen=True, slots=True)
class ManifestEntry:
    """A file of the bundle, as the manifest lists it."""

    path: str
    sha256: str
    size_bytes: int


class BundleZip:
    """A zip file that is being written; every entry is hashed on the way."""

    def __init__(self, archive: zipfile.ZipFile, at: ZipTime) -> None:
        self._archive = archive
        self._at = at
        self.listed: list[ManifestEntry] = []

    def add(self, path: str, chunks: Iterable[bytes], *, compress: bool = True) -> ManifestEntry:
        """Write one file. Images are stored without compression."""
        info = zipfile.ZipInfo(path, date_time=self._at)
        info.compress_type = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
        info.create_system = 3  # Unix on every machine, so that the permissions below count
        info.external_attr = (stat.S_IFREG | 0o644) << 16
        digest, size = hashlib.sha256(), 0
        with self._archive.open(info, "w", force_zip64=True) as entry:
            for chunk in chunks:
                digest.update(chunk)
                size += len(chunk)
                entry.write(chunk)
        listed = ManifestEntry(path, digest.hexdigest(), size)
        self.listed.append(listed)
        return listed


@contextmanager
def writing_bundle(target: Path, at: ZipTime, leaving: Callable[[Path], None] | None = None) -> Generator[BundleZip]:
    """A zip file that gets its name only when it is complete and durable; otherwise nothing is left of it.

    Args:
        target: the file.
        at: time stamp of its entries.
        leaving: called with the complete file before it gets its name; if it raises, no file appears.

    Raises:
        DataError: a file of this name exists.
        StoreError: the disk refused.
    """
    if target.exists():
        raise DataError("the file exists already", where=str(target), remedy="Name a new one; nothing is overwritten")
    part = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        with part.open("xb") as handle:
            with zipfile.ZipFile(handle, "w", allowZip64=True) as archive:
                yield BundleZip(archive, at)
            handle.flush()
            os.fsync(handle.fileno())
        if leaving is not None:
            leaving(part)
        os.link(part, target)  # unlike a rename, it never replaces a file that another process has made meanwhile
        DurableFiles().sync_directory(target.parent)
    except FileExistsError as error:
        raise DataError("the file exists already", where=str(target), remedy="Name a new one") from error
    except OSError as error:
        raise StoreError(
            f"the bundle cannot be written: {error.strerror or error}",
            where=str(error.filename or target),
            remedy="Check free space and permissions; the evidence is unchanged",
        ) from error
    finally:
        part.unlink(missing_ok=True)
