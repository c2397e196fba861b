"""Open the database of a data folder: SQLite in it, or the PostgreSQL database that its site.yaml names."""

from __future__ import annotations

from pathlib import Path

from service.core.errors import StoreError
from service.store.data_folder import SITE_FILE, site_of
from service.store.database import engine
from service.store.database.database import PATIENCE_S, Database
from service.store.database.postgres import open_postgres
from service.store.durable_effects import Files


def named_database(data_dir: Path) -> str | None:
    """Return the address of the database that a folder's site.yaml names; None for SQLite.

    Raises ConfigurationError.
    """
    site = site_of(data_dir)
    return None if site is None else site.database


def has_database(data_dir: Path) -> bool:
    """Return whether a folder is a data folder: it has a database, or names one. Raises ConfigurationError."""
    return engine.database_path(data_dir).is_file() or named_database(data_dir) is not None


def require_database(data_dir: Path) -> None:
    """Raise StoreError unless a folder is a data folder."""
    if not has_database(data_dir):
        raise StoreError(
            "there is no run data here",
            where=str(engine.database_path(data_dir)),
            remedy="Name the data folder with --data DIR, or with the environment variable ORTHOCAPTURE_DATA",
        )


def require_sqlite(data_dir: Path) -> None:
    """Raise StoreError if the record of a data folder is in PostgreSQL, which has tools of its own for this."""
    if named_database(data_dir) is not None:
        raise StoreError(
            "the record of this site is in PostgreSQL",
            where=str(data_dir / SITE_FILE),
            remedy="Back up and restore the database with PostgreSQL's own tools (docs/howto/site.md), or copy the "
            "record into a data folder of its own with `orthocapture store copy`",
        )


def open_database(data_dir: Path, files: Files, patience_s: float = PATIENCE_S) -> Database:
    """Open for writing. A write waits up to about `patience_s` for others.

    Raises:
        StoreVersionError: another version wrote the database, and it cannot be upgraded here.
        RecordDamagedError: it is not the one that the journal describes.
        StoreError: the folder has a database and names another.
    """
    url = named_database(data_dir)
    if url is None:
        return engine.open_database(data_dir, files, patience_s)
    _require_one(data_dir)
    return open_postgres(url, files, patience_s)


def open_read_only(data_dir: Path, files: Files) -> Database:
    """Open an existing database for reading. Raises StoreError if there is none, or as `open_database`."""
    url = named_database(data_dir)
    if url is None:
        return engine.open_read_only(data_dir, files)
    _require_one(data_dir)
    return open_postgres(url, files)


def _require_one(data_dir: Path) -> None:
    path = engine.database_path(data_dir)
    if path.exists():
        raise StoreError(
            f"this folder has a database of its own, and its {SITE_FILE} names another",
            where=str(path),
            remedy="Copy the record from a data folder without a site.yaml into a new one that has it "
            "(`orthocapture store copy FROM TO`); neither is used until one is gone",
        )
