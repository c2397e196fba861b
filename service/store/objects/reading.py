"""Reads an artefact wherever it is: in the spool, in the cache of fetched files, or in the object store."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Iterable
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from service.core.errors import ConfigurationError, IntegrityError, StoreError
from service.core.units import bytes_of_gigabytes
from service.store.artefacts import ArtefactFiles, Meter, hash_file, relative_path
from service.store.data_folder import folder_mode, make_folder, object_store_of, site_of
from service.store.objects.interface import ObjectStore, ObjectStoreAwayError, ObjectStoreError
from service.store.verification.chain_checks import FileState

if TYPE_CHECKING:
    from service.store.objects.s3 import S3Objects

FETCHED = "fetched"  # beside the artefacts; nothing of it is evidence
_YOUNG_S = 3600.0  # what was used since may still be read
_PART = ".part"


class SpoolReader:
    """Gives the files of a data folder to readers. Without a site.yaml it does what the artefact folder does."""

    def __init__(self, data_dir: Path, folder: ArtefactFiles) -> None:
        self._data = data_dir
        self._folder = folder
        self._objects: S3Objects | None = None
        self._most_bytes = 0.0

    def path(self, sha256: str, *, verify: bool = False) -> Path:
        """Return the file of a recorded artefact: from the spool, else as it was fetched from the object store.

        What is fetched is hashed when it arrives, with `verify` at each call. Raises IntegrityError if the file is
        altered, or missing wherever it could be.
        """
        try:
            return self._folder.verified_path(sha256) if verify else self._folder.path(sha256)
        except IntegrityError as missing:
            if (self._folder.folder / relative_path(sha256)).exists() or not self._has_store():
                raise
            return self._fetched(sha256, missing, verify=verify)

    def _has_store(self) -> bool:
        if self._objects is None:
            site = site_of(self._data)
            if site is not None and site.object_store is not None:
                from service.store.objects.opening import open_objects  # noqa: PLC0415 - for sites only

                self._objects = open_objects(self._data, site.object_store)
                self._most_bytes = bytes_of_gigabytes(site.spool.cache_gb)
        return self._objects is not None

    def _fetched(self, sha256: str, missing: IntegrityError, *, verify: bool) -> Path:
        target = self._data / FETCHED / relative_path(sha256)
        try:
            if target.is_file():
                os.utime(target)
                if not verify or hash_file(target)[0] == sha256:
                    return target
                target.unlink(missing_ok=True)  # it is only a copy: another one is fetched
            self._fetch(sha256, target)
        except (ObjectStoreError, ConfigurationError) as error:
            raise IntegrityError(
                f"{missing.what}, and {error.what}", where=f"{missing.where}; {error.where}", remedy=missing.remedy
            ) from error
        except OSError as error:
            raise StoreError(
                f"a fetched file cannot be stored: {error.strerror or error}",
                where=str(error.filename or target),
                remedy="Look at the disk of the data folder; the object store has the file",
            ) from error
        return target

    def _fetch(self, sha256: str, target: Path) -> None:
        assert self._objects is not None
        for folder in (target.parent.parent, target.parent):
            make_folder(folder, folder_mode(folder.parent))
        part = target.with_name(f"{secrets.token_hex(8)}{_PART}")
        try:
            self._objects.fetch(sha256, part)
            part.chmod(part.stat().st_mode & 0o444)
            descriptor = os.open(part, os.O_RDONLY | os.O_CLOEXEC)
            try:
                os.fsync(descriptor)  # a name must not come before its content
            finally:
                os.close(descriptor)
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)
        self._make_room(target)

    def _make_room(self, but: Path) -> None:
        """Remove the files that were not used for longest while the cache is too large; never those in use now."""
        held: list[tuple[float, int, Path]] = []
        for path in (self._data / FETCHED).glob("*/*"):
            try:
                status = path.stat()
            except FileNotFoundError:
                continue
            held.append((status.st_mtime, status.st_size, path))
        size_bytes, newest_s = sum(size for _, size, _ in held), but.stat().st_mtime
        for used_s, size, path in sorted(held):
            if size_bytes <= self._most_bytes or newest_s - used_s < _YOUNG_S:
                return
            path.unlink(missing_ok=True)
            size_bytes -= size


_MISSING = "the file is missing"


class FilesElsewhere:
    """The files of an object store, each read whole or, with `stated_hashes`, known by the store's own statement."""

    def __init__(self, opened: Callable[[], ObjectStore], *, stated_hashes: bool) -> None:
        self._opened = cache(opened)  # when the first file is not here, and not before
        self._stated_hashes = stated_hashes

    def state(self, sha256: str, shown: str) -> FileState:
        """Return what the object store has of a file; its `problem` says why it has nothing.

        Raises ConfigurationError if the store cannot be used at all: its keys are missing, say.
        """
        objects = self._opened()
        named = f"{shown} (in {objects.place})"
        try:
            stated = objects.stat(sha256)
            if stated is None:
                return FileState(shown, "", 0, f"{_MISSING}, here and in the object store")
            if self._stated_hashes:
                problem = (
                    "" if stated.sha256 else "the file is not here, and the object store states no SHA-256 of it"
                )
                return FileState(named, stated.sha256, stated.size_bytes, problem, "stated")
            meter = Meter(objects.chunks(sha256))
            for _ in meter:
                pass
        except ObjectStoreAwayError as error:
            return FileState(shown, "", 0, error.what, "away")
        except ObjectStoreError as error:
            return FileState(shown, "", 0, f"{_MISSING} here, and {error.what}", "fetched")
        return FileState(named, meter.sha256, meter.size, "", "fetched")


def files_elsewhere(data_dir: Path, *, stated_hashes: bool = False) -> FilesElsewhere | None:
    """Return the files of a site's object store; None for a data folder without one. Raises ConfigurationError."""
    section = object_store_of(data_dir)
    if section is None:
        return None
    from service.store.objects.opening import open_objects  # noqa: PLC0415 - for sites only

    return FilesElsewhere(partial(open_objects, data_dir, section), stated_hashes=stated_hashes)


def not_elsewhere(data_dir: Path, names: Iterable[str]) -> list[str]:
    """Return the hashes of those files that no object store states to have. Raises ConfigurationError."""
    away = files_elsewhere(data_dir, stated_hashes=True)
    return [name for name in names if away is None or away.state(name, "").sha256 != name]
