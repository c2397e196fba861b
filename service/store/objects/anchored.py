"""Reads the anchors of a data folder's evidence from its object store, for those who verify."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from service.core.errors import StoreError
from service.store.data_folder import object_store_of
from service.store.objects.anchors import FOLDER
from service.store.verification.anchor_checks import ReadAnchors

_AT_ONCE = 8
_MOST_BYTES = 64 << 20  # the ends of half a million chains


@dataclass(frozen=True, slots=True)
class UnreadAnchors:
    """The anchors of an object store that could not be read, and why."""

    place: str
    why: str


def read_anchors(data_dir: Path) -> ReadAnchors | UnreadAnchors | None:
    """Return the anchors that the site.yaml of a folder names; None if it has anchors nowhere.

    A store that is away, or that cannot be opened from here, is no error: a sentence says what was not compared.
    Raises ConfigurationError if the site's file itself is wrong.
    """
    section = object_store_of(data_dir)
    if section is None or section.lock_days is None:
        return None
    # Imported here: for sites only.
    from service.store.objects.anchors import LockedObjects  # noqa: PLC0415
    from service.store.objects.opening import open_objects  # noqa: PLC0415

    try:
        objects = open_objects(data_dir, section)
        objects.require_bucket()
        locked = LockedObjects(objects)
        listed = list(locked.versions(FOLDER))
        wanted = [found for found in listed if not found.deletion and found.size_bytes <= _MOST_BYTES]
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            read = [version for version in pool.map(locked.read, wanted) if version is not None]
    except StoreError as error:
        return UnreadAnchors(section.place, error.what)
    return ReadAnchors(
        place=section.place,
        versions=read,
        deletions=[found for found in listed if found.deletion],
        unread=[found for found in listed if found.size_bytes > _MOST_BYTES],
        lock_days=section.lock_days,
        patience=timedelta(hours=section.anchor_within_hours),
        at=datetime.now(UTC),
    )
