"""Recorded files of a run, filtered, searched and paged in SQL."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, text

from service.audit.record.filters import Filter
from service.audit.record.run_rows import PAGE, head, plain
from service.store.records import UnknownRunError

_LARGEST_PAGE = 10**6


@dataclass(frozen=True, slots=True)
class ArtefactFilter(Filter):
    """A filter for artefacts; an empty field matches all."""

    kind: str = ""
    step: str = ""
    device: str = ""
    viewpoint: str = ""
    q: str = ""


@dataclass(frozen=True, slots=True)
class ArtefactRow:
    """A recorded artefact."""

    seq: int
    position: int
    sha256: str
    kind: str
    media_type: str
    size_bytes: int
    original_name: str
    device: str
    step: str
    attempt: int | None
    viewpoint: str
    who: str
    at_utc: str
    monotonic_s: float
    record_sha256: str

    @property
    def is_picture(self) -> bool:
        """Whether a browser can show it."""
        return self.media_type in ("image/jpeg", "image/png")


@dataclass(frozen=True, slots=True)
class ArtefactPage:
    """A page of artefacts, and the number of pages and matches."""

    rows: Sequence[ArtefactRow]
    page: int
    pages: int
    count: int
    size_bytes: int  # number of matches


_COLUMNS = (
    "seq, position, sha256, kind, media_type, size_bytes, original_name, device, step, attempt, viewpoint, who, "
    "at_utc, monotonic_s, record_sha256"
)


def artefacts_page(
    connection: Connection, run_id: str, wanted: ArtefactFilter, *, page: int = 1, size: int = PAGE
) -> ArtefactPage:
    """One page, in the order of the events; a page number out of range gives the nearest. Raises UnknownRunError."""
    head(connection, run_id)
    where, values = _where(run_id, wanted)
    totals = connection.execute(
        text(f"SELECT count(*) AS n, coalesce(sum(size_bytes), 0) AS size FROM artefacts WHERE {where}"), values
    ).one()
    pages = max(1, math.ceil(totals.n / size))
    page = min(max(page, 1), pages, _LARGEST_PAGE)
    rows = connection.execute(
        text(
            f"SELECT {_COLUMNS} FROM artefacts WHERE {where} ORDER BY run_id, seq, position "
            "LIMIT :limit OFFSET :offset"
        ),
        values | {"limit": size, "offset": (page - 1) * size},
    )
    return ArtefactPage([to_row(row) for row in rows], page, pages, totals.n, totals.size)


def _where(run_id: str, wanted: ArtefactFilter) -> tuple[str, dict[str, Any]]:
    conditions, values = ["run_id = :run"], {"run": plain(run_id)}
    for column in ("kind", "step", "device", "viewpoint"):
        value = getattr(wanted, column)
        if value:
            conditions.append(f"{column} = :{column}")
            values[column] = plain(value)
    for index, word in enumerate(plain(wanted.q)[:200].replace("\0", " ").split()[:8]):
        escaped = word.replace("\\", r"\\").replace("%", r"\%").replace("_", r"\_")
        columns = ("original_name", "viewpoint", "sha256", "kind", "step", "who")
        conditions.append("(" + " OR ".join(f"{c} LIKE :word{index} ESCAPE '\\'" for c in columns) + ")")
        values[f"word{index}"] = f"%{escaped}%"
    return " AND ".join(conditions), values


def to_row(row: Any) -> ArtefactRow:
    """A row of the table `artefacts` as an ArtefactRow."""
    return ArtefactRow(
        seq=row.seq,
        position=row.position,
        sha256=row.sha256,
        kind=row.kind,
        media_type=row.media_type,
        size_bytes=row.size_bytes,
        original_name=row.original_name,
        device=row.device,
        step=row.step or "",
        attempt=row.attempt,
        viewpoint=row.viewpoint or "",
        who=row.who,
        at_utc=row.at_utc,
        monotonic_s=row.monotonic_s,
        record_sha256=row.record_sha256,
    )


def artefacts_of_events(connection: Connection, run_id: str, seqs: Sequence[int]) -> list[ArtefactRow]:
    """The artefacts that these events brought."""
    if not seqs:
        return []
    rows = connection.execute(
        text(
            f"SELECT {_COLUMNS} FROM artefacts WHERE run_id = :run AND seq IN (SELECT value FROM json_each(:seqs)) "
            "ORDER BY seq, position LIMIT 1000"
        ),
        {"run": plain(run_id), "seqs": str(list(seqs))},
    )
    return [to_row(row) for row in rows]


def one_artefact(connection: Connection, run_id: str, sha256: str) -> list[ArtefactRow]:
    """Every record of a file in this run; the first says where it came from. Raises UnknownRunError."""
    head(connection, run_id)
    rows = connection.execute(
        text(
            f"SELECT {_COLUMNS} FROM artefacts WHERE sha256 = :sha256 AND run_id = :run "
            "ORDER BY seq, position LIMIT 100"
        ),
        {"run": plain(run_id), "sha256": plain(sha256)},
    )
    found = [to_row(row) for row in rows]
    if not found:
        raise UnknownRunError(
            "the run has no artefact of this SHA-256",
            where=plain(sha256)[:80],
            remedy="Search for it among the artefacts",
        )
    return found


def artefact_facets(connection: Connection, run_id: str) -> dict[str, dict[str, int]]:
    """The values to filter by, each with its number of artefacts."""
    rows = connection.execute(
        text("SELECT kind, step, device, count(*) AS n FROM artefacts WHERE run_id = :run GROUP BY 1, 2, 3"),
        {"run": plain(run_id)},
    )
    counts: dict[str, dict[str, int]] = {"kind": {}, "step": {}, "device": {}}
    for row in rows:
        for name, value in (("kind", row.kind), ("step", row.step), ("device", row.device)):
            if value:
                counts[name][value] = counts[name].get(value, 0) + row.n
    return counts
