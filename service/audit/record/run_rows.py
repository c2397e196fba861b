"""The runs of a data folder, for the auditor's pages: read in SQL, without reading their events."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, text

from service.store.records import SITE, UnknownRunError

PAGE = 50  # events or artefacts on one page
LARGEST_SEQ = 2**53


@dataclass(frozen=True, slots=True)
class RunBasics:
    """What never changes in a run, and the present end of its chain."""

    run_id: str
    created_utc: str
    simulated: bool
    protocol: str  # its id; "" if the first event cannot be read
    version: str
    operator: str
    origin: str  # captured, imported
    head_seq: int
    head_sha256: str


def runs(connection: Connection, run_id: str | None = None) -> list[RunBasics]:
    """All runs, newest first; or the run of this name, if there is one."""
    rows = connection.execute(
        text(
            "SELECT r.run_id, r.created_utc, r.simulated, h.seq, h.sha256, "
            "json_extract(e.payload, '$.protocol_id') AS protocol, "
            "json_extract(e.payload, '$.protocol_version') AS version, "
            "json_extract(e.payload, '$.operator') AS operator, "
            "json_extract(e.payload, '$.origin') AS origin "
            "FROM runs AS r LEFT JOIN heads AS h ON h.run_id = r.run_id "
            "LEFT JOIN events AS e ON e.run_id = r.run_id AND e.seq = 1 AND json_valid(e.payload) "
            "WHERE r.run_id <> :site AND (:run IS NULL OR r.run_id = :run) ORDER BY r.created_utc DESC, r.run_id DESC"
        ),
        {"site": SITE, "run": None if run_id is None else plain(run_id)},
    )
    return [
        RunBasics(
            run_id=row.run_id,
            created_utc=row.created_utc,
            simulated=bool(row.simulated),
            protocol=str(row.protocol or ""),
            version=str(row.version or ""),
            operator=str(row.operator or ""),
            origin=str(row.origin or "captured"),
            head_seq=row.seq or 0,
            head_sha256=row.sha256 or "",
        )
        for row in rows
    ]


def head(connection: Connection, run_id: str) -> tuple[int, str]:
    """Number and hash of the last event of a run or of the site. Raises UnknownRunError."""
    row = connection.execute(
        text("SELECT seq, sha256 FROM heads WHERE run_id = :run"), {"run": plain(run_id)}
    ).one_or_none()
    if row is None:
        raise UnknownRunError(f"there is no run {run_id!r}", remedy="Choose one from the list of runs")
    return row.seq, row.sha256


def plain(value: str) -> str:
    """The text without lone surrogates, which a request may hold and SQLite refuses."""
    return value.encode("utf-8", "replace").decode()
