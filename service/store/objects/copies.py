"""The rows of `copies`: which artefacts an object store has confirmed, and which still wait for their upload."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import ColumnElement, Connection, func, insert, select, update

from service.core.text.words import counted
from service.core.units import gigabytes
from service.store.database.tables import artefacts, copies
from service.store.store import Store


@dataclass(frozen=True, slots=True)
class Recorded:
    """A recorded file: its hash, and its size in bytes."""

    sha256: str
    size_bytes: int


@dataclass(frozen=True, slots=True)
class Waiting:
    """The files that an object store has not confirmed yet, in figures.

    Attributes:
        files: how many files wait.
        size_bytes: their size.
        since_utc: when the oldest of them was recorded; "" if none waits.
        confirmed: how many files the store has confirmed.
    """

    files: int
    size_bytes: int
    since_utc: str
    confirmed: int

    @property
    def sentence(self) -> str:
        """The same as a sentence for people."""
        if not self.files:
            return f"all {counted(self.confirmed, 'file')} are in the object store"
        waits = "waits" if self.files == 1 else "wait"
        return (
            f"{counted(self.files, 'file')} ({gigabytes(self.size_bytes):.2f} GB) {waits} for the object store since "
            f"{self.since_utc[:16].replace('T', ' ')} UTC; {self.confirmed} are there"
        )


def _unconfirmed(place: str) -> ColumnElement[bool]:
    there = select(copies.c.sha256).where(copies.c.sha256 == artefacts.c.sha256, copies.c.place == place)
    return ~there.exists()


def read_waiting(connection: Connection, place: str) -> Waiting:
    """Return what a place has not confirmed yet, in figures."""
    each = (
        select(func.max(artefacts.c.size_bytes).label("size"), func.min(artefacts.c.at_utc).label("at"))
        .where(_unconfirmed(place))
        .group_by(artefacts.c.sha256)
        .subquery()
    )
    row = connection.execute(select(func.count(), func.sum(each.c.size), func.min(each.c.at)).select_from(each)).one()
    confirmed = connection.execute(select(func.count()).where(copies.c.place == place)).scalar_one()
    return Waiting(int(row[0]), int(row[1] or 0), str(row[2] or ""), int(confirmed))


def next_waiting(connection: Connection, place: str, but: Sequence[str], most: int) -> list[Recorded]:
    """Return files that a place has not confirmed yet, the oldest first, without those named."""
    rows = connection.execute(
        select(artefacts.c.sha256, func.max(artefacts.c.size_bytes).label("size_bytes"))
        .where(_unconfirmed(place))
        .group_by(artefacts.c.sha256)
        .order_by(func.min(artefacts.c.at_utc), artefacts.c.sha256)
        .limit(most + len(but))
    )
    passed_over = set(but)
    found = (Recorded(str(row.sha256), int(row.size_bytes)) for row in rows)
    return [file for file in found if file.sha256 not in passed_over][:most]


def write_confirmed(store: Store, place: str, confirmed: Sequence[Recorded], at_utc: str) -> None:
    """Record that a place has just stated these files, in a transaction of its own."""
    if not confirmed:
        return
    with store.database.writing() as connection:
        for file in confirmed:
            here = (copies.c.sha256 == file.sha256) & (copies.c.place == place)
            if connection.execute(update(copies).where(here).values(checked_utc=at_utc)).rowcount:
                continue
            new = {"sha256": file.sha256, "place": place, "size_bytes": file.size_bytes, "at_utc": at_utc}
            connection.execute(insert(copies).values(**new, checked_utc=at_utc))
