"""The rows of `copies`: which artefacts an object store has confirmed, and which still wait for their upload."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

from sqlalchemy import Connection, func, insert, select, text, update

from service.core.units import gigabytes
from service.core.words import counted
from service.store.database.tables import copies, event_index
from service.store.durable_effects import utc_text
from service.store.store import Store


@dataclass(frozen=True, slots=True)
class Recorded:
    """A recorded file.

    Attributes:
        sha256: its hash.
        size_bytes: its size.
        position: the position of the event that brought it among all events; 0 if it does not matter.
    """

    sha256: str
    size_bytes: int
    position: int = 0


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


# CROSS JOIN: SQLite then reads the index of events first, from `after` on, and not every artefact.
_FROM = """
FROM event_index AS e CROSS JOIN artefacts AS a
WHERE e.position > :after AND a.run_id = e.run_id AND a.seq = e.seq
AND NOT EXISTS (SELECT 1 FROM copies AS c WHERE c.sha256 = a.sha256 AND c.place = :place)
"""
_SEEN_BEFORE = """
AND NOT EXISTS (
  SELECT 1 FROM artefacts AS b CROSS JOIN event_index AS f
  WHERE b.sha256 = a.sha256 AND f.run_id = b.run_id AND f.seq = b.seq AND f.position <= :after
)
"""
_FIGURES = text(
    "SELECT count(*) AS files, sum(size_bytes) AS size_bytes, min(at_utc) AS since_utc FROM ("
    f"SELECT max(a.size_bytes) AS size_bytes, min(a.at_utc) AS at_utc {_FROM} {_SEEN_BEFORE} GROUP BY a.sha256) AS w"
)
_ALL_FIGURES = text("""
SELECT count(*) AS files, sum(size_bytes) AS size_bytes, min(at_utc) AS since_utc FROM (
  SELECT max(a.size_bytes) AS size_bytes, min(a.at_utc) AS at_utc FROM artefacts AS a
  WHERE NOT EXISTS (SELECT 1 FROM copies AS c WHERE c.sha256 = a.sha256 AND c.place = :place)
  GROUP BY a.sha256
) AS w
""")
_NEXT = text(
    f"SELECT e.position AS place, a.sha256 AS sha256, a.size_bytes AS size_bytes {_FROM} "
    "ORDER BY e.position, a.position LIMIT :most"
)
_LATEST = text(
    "SELECT a.size_bytes AS size_bytes, a.at_utc AS at_utc FROM event_index AS e CROSS JOIN artefacts AS a "
    "WHERE e.position > :after AND a.run_id = e.run_id AND a.seq = e.seq ORDER BY e.position DESC LIMIT :most"
)
_LATEST_EVENTS, _LATEST_FILES = 20_000, 500  # among which the rate of recording is looked for
_SHORTEST_S = 60.0


def last_position(connection: Connection) -> int:
    """Return the position of the newest event of all chains; 0 if there is none."""
    return int(connection.execute(select(func.max(event_index.c.position))).scalar() or 0)


def count_confirmed(connection: Connection, place: str) -> int:
    """Return how many files a place has confirmed; this reads all of its rows."""
    return int(connection.execute(select(func.count()).where(copies.c.place == place)).scalar_one())


def is_confirmed(connection: Connection, place: str, sha256: str) -> bool:
    """Return whether a place has confirmed a file."""
    here = (copies.c.sha256 == sha256) & (copies.c.place == place)
    return connection.execute(select(copies.c.sha256).where(here)).first() is not None


def read_waiting(connection: Connection, place: str, after: int = 0, confirmed: int | None = None) -> Waiting:
    """Return what a place has not confirmed yet, in figures.

    Args:
        connection: a connection within a transaction.
        place: the name of the object store.
        after: position of an event: what was recorded up to it is left out, and so is later the same content.
        confirmed: how many files it has confirmed; None to count them, which reads all of their rows.
    """
    statement, values = (_FIGURES, {"after": after}) if after > 0 else (_ALL_FIGURES, {})
    row = connection.execute(statement, values | {"place": place}).one()
    there = count_confirmed(connection, place) if confirmed is None else confirmed
    return Waiting(int(row.files), int(row.size_bytes or 0), str(row.since_utc or ""), there)


def next_waiting(connection: Connection, place: str, after: int, but: Collection[str], most: int) -> list[Recorded]:
    """Return files recorded after an event that a place has not confirmed, the oldest first, without those named."""
    rows = connection.execute(_NEXT, {"after": after, "place": place, "most": most + len(but)})
    found: dict[str, Recorded] = {}
    for row in rows:
        if row.sha256 not in but:
            found.setdefault(row.sha256, Recorded(str(row.sha256), int(row.size_bytes), int(row.place)))
    return list(found.values())[:most]


def read_rate(connection: Connection, now: datetime) -> float:
    """Return the bytes a second that were recorded in the last hour, or since the first of its newest files; or 0."""
    values = {"after": last_position(connection) - _LATEST_EVENTS, "most": _LATEST_FILES}
    begin = utc_text(now - timedelta(hours=1))
    rows = [row for row in connection.execute(_LATEST, values) if row.at_utc >= begin]
    if not rows:
        return 0.0
    passed_s = (now - datetime.fromisoformat(str(rows[-1].at_utc))).total_seconds()
    return sum(int(row.size_bytes) for row in rows) / max(_SHORTEST_S, passed_s)


def write_confirmed(store: Store, place: str, confirmed: Sequence[Recorded], at_utc: str) -> int:
    """Record that a place has just stated these files, in a transaction of its own. Returns how many are new."""
    if not confirmed:
        return 0
    inserted = 0
    with store.database.writing() as connection:
        for file in confirmed:
            here = (copies.c.sha256 == file.sha256) & (copies.c.place == place)
            if connection.execute(update(copies).where(here).values(checked_utc=at_utc)).rowcount:
                continue
            new = {"sha256": file.sha256, "place": place, "size_bytes": file.size_bytes, "at_utc": at_utc}
            connection.execute(insert(copies).values(**new, checked_utc=at_utc))
            inserted += 1
    return inserted
