"""Used and free disk space, and what could be deleted: the figures for a forecast of disk space."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

from sqlalchemy import Connection, func, select, text

from service.core.disk_space import LEAST_FREE_BYTES, Forecast, Usage, forecast, size_words
from service.core.errors import SpaceShortError
from service.core.protocol.models import Protocol
from service.core.run.state import RunState
from service.store.database.tables import artefacts, event_index
from service.store.store import Store

_VIEWS = ("viewpoint_captured", "view_held", "view_imported")
_LOOKED_AT = 30  # newest runs among which one of the same protocol with photographs is looked for
# Folders below the data folder that hold no evidence.
_REMOVABLE: Mapping[str, str] = {
    "exports": "exports that were copied elsewhere",
    "logs": "logs",
    "artefacts/tmp": "remains of interrupted writes",
}
_WORTH_SAYING_BYTES = 1_000_000


def forecast_of(
    store: Store, protocol: Protocol, state: RunState | None = None, *, simulated: bool = False
) -> Forecast:
    """The forecast for a run in progress, or for one about to begin (`state` None). Raises StoreError."""
    run_id = "" if state is None else state.run_id
    with store.database.reading() as connection:
        here = read_usage(connection, run_id) if run_id else Usage()
        before = _before(connection, run_id, protocol.id, simulated=simulated if state is None else state.simulated)
    return forecast(
        protocol,
        state,
        here,
        before,
        store.free_bytes(),
        simulated=simulated if state is None else state.simulated,
    )


def require_space(store: Store, found: Forecast) -> None:
    """Raise SpaceShortError, with a remedy, if no new work may begin."""
    if found.verdict == "stop":
        folder = store.database_path.parent
        raise SpaceShortError(found.words, where=str(folder), remedy=_helps(folder))


def require_export_space(store: Store, run_id: str, target: Path) -> None:
    """Raise SpaceShortError if a copy of a run's files would not fit or would use space kept for the evidence."""
    with store.database.reading() as connection:
        usage = read_usage(connection, run_id)
    needed = usage.view_bytes + usage.computed_bytes + usage.other_bytes
    try:
        free, same = shutil.disk_usage(target.parent).free, _same_disk(target.parent, store.database_path.parent)
    except OSError:  # writing the export will report it
        return
    kept = LEAST_FREE_BYTES if same else 0
    if free - kept < needed:
        last = f"; the last {size_words(kept)} are kept for the evidence" if kept else ""
        raise SpaceShortError(
            f"this export needs about {size_words(needed)}, and {size_words(free)} are free{last}",
            where=str(target.parent),
            remedy="Export to another disk, or make room; nothing was written",
        )


def _same_disk(one: Path, other: Path) -> bool:
    return one.stat().st_dev == other.stat().st_dev


def read_usage(connection: Connection, run_id: str) -> Usage:
    """Recorded sizes of a run's files so far."""
    of_event = (event_index.c.run_id == artefacts.c.run_id) & (event_index.c.seq == artefacts.c.seq)
    found = (
        select(event_index.c.kind, func.sum(artefacts.c.size_bytes), func.count(artefacts.c.seq.distinct()))
        .join(event_index, of_event)
        .where(artefacts.c.run_id == run_id)
        .group_by(event_index.c.kind)
    )
    sizes = {kind: (int(size), int(count)) for kind, size, count in connection.execute(found)}
    computed, _ = sizes.get("job_finished", (0, 0))
    views = [sizes[kind] for kind in _VIEWS if kind in sizes]
    total = sum(size for size, _ in sizes.values())
    taken = sum(size for size, _ in views)
    return Usage(sum(count for _, count in views), taken, computed, total - taken - computed)


def _before(connection: Connection, run_id: str, protocol_id: str, *, simulated: bool) -> Usage | None:
    """Usage of the newest other run of the protocol with photographs; None if there is none."""
    rows = connection.execute(
        text(
            "SELECT r.run_id FROM runs AS r JOIN events AS e ON e.run_id = r.run_id AND e.seq = 1 "
            "WHERE e.kind = 'run_started' AND r.simulated = :simulated AND r.run_id != :run "
            "AND json_extract(e.payload, '$.protocol_id') = :protocol ORDER BY r.created_utc DESC LIMIT :most"
        ),
        {"simulated": int(simulated), "run": run_id, "protocol": protocol_id, "most": _LOOKED_AT},
    )
    usages = (read_usage(connection, row.run_id) for row in rows.all())
    return next((usage for usage in usages if usage.views), None)


def _helps(folder: Path) -> str:
    sizes = {words: _size(folder / name) for name, words in _REMOVABLE.items()}
    worth = [f"{words}: {size_words(size)}" for words, size in sizes.items() if size > _WORTH_SAYING_BYTES]
    inside = f". In the data folder you can delete {'; '.join(worth)}" if worth else ""
    return f"Move other files off this disk{inside}. Then try again; nothing that was captured is lost"


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) if folder.is_dir() else 0
