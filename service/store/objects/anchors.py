"""Writes the anchors of the evidence into the object store, as the uploader comes to it.

It is beside every capture and signature, and never in their way.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from sqlalchemy import select

from service.core.errors import StoreError
from service.store.database.tables import heads
from service.store.durable_effects import utc_text
from service.store.objects.anchor_forms import (
    LINES,
    ROOTS,
    Head,
    LineAnchor,
    RootAnchor,
    line_name,
    line_number,
    merkle_root,
)
from service.store.objects.locked import LockedObjects
from service.store.signatures.log import NAME as LOG_NAME
from service.store.signatures.signing import sign
from service.store.store import Store

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Place:
    """How far the log of signatures was read: bytes, and whole lines."""

    offset: int = 0
    lines: int = 0


class AnchorWriter:
    """Writes the anchors of one data folder. It belongs to the uploader: no capture and no signature waits for it."""

    def __init__(self, store: Store, objects: LockedObjects, lock_days: int) -> None:
        self._store = store
        self._objects = objects
        self._locked_for = timedelta(days=lock_days)
        self._log: Path = store.database_path.parent / LOG_NAME
        self._held: set[int] | None = None  # lines that have an anchor, whatever it holds
        self._place = _Place()
        self._root_day = ""
        self.beyond = 0  # lines that have an anchor and are not in the log

    def write(self, stopped: Callable[[], bool] = lambda: False) -> int:
        """Anchor what has no anchor yet. Returns how many were written. Raises ObjectStoreError, StoreError.

        What has an anchor already is left as it is, whatever it holds: `audit verify` compares.
        """
        new = self._new_lines()
        if not new and not self._place.lines:
            return 0  # nothing was signed yet
        if self._held is None:
            numbers = (line_number(listed.name) for listed in self._objects.versions(LINES))
            self._held = {number for number in numbers if number is not None}
        written = 0
        for line in new:
            if stopped():
                return written
            number = self._place.lines + 1
            if number not in self._held:
                until = self._until()
                anchor = LineAnchor(line.decode(errors="replace").rstrip("\n"), utc_text(until))
                written += self._objects.store(line_name(number), anchor.content(), until)
                self._held.add(number)
            self._place = _Place(self._place.offset + len(line), number)
        self.beyond = sum(number > self._place.lines for number in self._held)
        return written + self._write_root()

    def _until(self) -> datetime:
        return (self._store.clock.utc_now() + self._locked_for).replace(microsecond=0)

    def _new_lines(self) -> list[bytes]:
        """Return the whole lines of the log after the last one that was anchored; all again if the log was cut."""
        try:
            with self._log.open("rb") as stream:
                if stream.seek(0, 2) < self._place.offset:
                    _LOG.error("the log of signatures is shorter than it was: run `orthocapture audit verify all`")
                    self._place = _Place()
                stream.seek(self._place.offset)
                found = stream.read()
        except FileNotFoundError:
            return []
        except OSError as error:
            raise StoreError(
                f"the log of signatures cannot be read: {error.strerror or error}",
                where=str(self._log),
                remedy="Check the permissions of the data folder",
            ) from error
        return found[: found.rfind(b"\n") + 1].splitlines(keepends=True)

    def _write_root(self) -> int:
        """Anchor the ends of all chains, the first time on each day (UTC)."""
        now = self._store.clock.utc_now().astimezone(UTC)
        day = now.date().isoformat()
        if self._root_day == day:
            return 0
        written = 0
        if not any(True for _ in self._objects.versions(f"{ROOTS}{day}")):
            until = self._until()
            content = self.root(day, utc_text(now), utc_text(until)).content()
            written = int(self._objects.store(f"{ROOTS}{day}", content, until))
        self._root_day = day
        return written

    def root(self, day: str, at_utc: str, until_utc: str) -> RootAnchor:
        """Return the anchor of a day: the ends of all chains now, and their root, signed."""
        with self._store.database.reading() as connection:
            rows = connection.execute(select(heads.c.run_id, heads.c.seq, heads.c.sha256)).all()
        ends: tuple[Head, ...] = tuple(sorted((str(row.run_id), int(row.seq), str(row.sha256)) for row in rows))
        unsigned = RootAnchor(day, at_utc, until_utc, merkle_root(ends), ends)
        key_id, signature = sign(self._store, unsigned.message())
        return replace(unsigned, key_id=key_id, signature=signature)
