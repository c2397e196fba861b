"""The search for files in the site's object store that are not in the artefact folder, for those who verify."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache, partial
from pathlib import Path

from service.store.artefacts import Meter
from service.store.data_folder import object_store_of
from service.store.objects.interface import ObjectStore, ObjectStoreAwayError, ObjectStoreError
from service.store.verification.chain_checks import FileState

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
