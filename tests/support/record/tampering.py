"""Rewrites evidence as somebody with full access to database and journal but without the signing key."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

from service.store.artefacts import record_sha256
from service.store.database.engine import database_path
from service.store.database.tables import artefacts
from service.store.durable_effects import DurableFiles
from service.store.events import event_sha256, parse_canonical
from service.store.journal import NAME, Journal, every_row
from tests.support.record.outsider import INDEX_AGAIN, is_postgres, rows, tamper

_EVENT: tuple[str, ...] = ("seq", "run_id", "at_utc", "monotonic_s", "actor", "previous_sha256", "payload", "sha256")


def journal_anew(data: Path) -> None:
    """Make the journal anew, as a forger does who can write it too, so that it fits the database as it is."""
    if is_postgres(data):  # a server keeps its own
        return
    (data / NAME).unlink(missing_ok=True)
    with closing(sqlite3.connect(database_path(data), isolation_level=None)) as connection:
        tail = Journal(data, DurableFiles()).begin(every_row(connection), 0)
        connection.execute(f"PRAGMA user_version = {tail.number}")


def rewrite_to_the_end(data: Path, run_id: str, seq: int, **changes: Any) -> None:
    """Change fields of an event and make everything after it consistent: links, hashes, artefact rows, head."""
    statements: list[str] = []
    previous = ""
    for row in rows(data, f"SELECT {', '.join(_EVENT)} FROM events WHERE run_id = '{run_id}' ORDER BY seq"):
        fields: dict[str, Any] = dict(zip(_EVENT, row, strict=True))
        if int(str(fields["seq"])) < seq:
            continue
        fields["payload"] = parse_canonical(str(fields["payload"]))
        if fields["seq"] == seq:
            fields |= changes
        else:
            fields["previous_sha256"] = previous
        previous = event_sha256(fields)
        where = f"run_id = '{run_id}' AND seq = {fields['seq']}"
        statements += [
            f"UPDATE events SET actor = '{fields['actor']}', previous_sha256 = '{fields['previous_sha256']}', "
            f"sha256 = '{previous}' WHERE {where}",
            *_rows_again(data, where, previous),
        ]
    statements.append(f"UPDATE heads SET sha256 = '{previous}' WHERE run_id = '{run_id}'")
    if seq == 1:
        statements.append(
            f"UPDATE runs SET root_sha256 = (SELECT sha256 FROM events WHERE run_id = '{run_id}' LIMIT 1)"
        )
    tamper(data, *statements)


def _rows_again(data: Path, where: str, event: str) -> list[str]:
    changed: list[str] = []
    for row in rows(data, f"SELECT * FROM artefacts WHERE {where}"):
        fields = dict(zip(artefacts.columns.keys(), row, strict=True))
        digest = record_sha256(event, fields)
        changed.append(
            f"UPDATE artefacts SET record_sha256 = '{digest}' WHERE {where} AND position = {fields['position']}"
        )
    return changed


def alter_row(data: Path, run_id: str, seq: int, device: str) -> None:
    """Change the device in an artefact's row, and adapt the row's unkeyed hash."""
    where = f"run_id = '{run_id}' AND seq = {seq}"
    ((event,),) = rows(data, f"SELECT sha256 FROM events WHERE {where}")
    tamper(data, f"UPDATE artefacts SET device = '{device}' WHERE {where}")
    tamper(data, *_rows_again(data, where, str(event)))


def without_signatures_from(run: str, seq: int) -> list[str]:
    """SQL that deletes the signatures of a chain from an event on."""
    return [f"DELETE FROM checkpoints WHERE run_id = '{run}' AND seq >= {seq}"]


def cut(run: str, seq: int) -> list[str]:
    """SQL that consistently truncates a chain before `seq`."""
    of = f"run_id = '{run}' AND seq >= {seq}"
    last = f"(SELECT sha256 FROM events WHERE run_id = '{run}' AND seq = {seq - 1})"
    return [
        *without_signatures_from(run, seq),
        f"DELETE FROM artefacts WHERE {of}",
        f"DELETE FROM event_index WHERE {of}",
        f"DELETE FROM events WHERE {of}",
        f"UPDATE heads SET seq = {seq - 1}, sha256 = {last} WHERE run_id = '{run}'",
        *INDEX_AGAIN,
    ]
