"""The verdict of verification on an altered record, and the parts of a database that verification does not read."""

from __future__ import annotations

import functools
import gc
import hashlib
import sqlite3
import traceback
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

from sqlalchemy import Connection

from service.core.errors import OrthocaptureError
from service.store import journal as journal_lines
from service.store.database import engine as database
from service.store.database.engine import database_path
from service.store.signatures import log as signature_log
from service.store.signatures.log import LogLine
from service.store.verification import chain_checks as audit_checks
from service.store.verification import derived_checks, file_checks
from service.store.verification import signature_checks as audit_signatures
from service.store.verification import verify as audit
from service.store.verification.chain_checks import Fault
from tests.support.torture.audit.record import Record

_CONTENTS_COME_FROM = (
    "SELECT * FROM event_words_data",
    "SELECT * FROM event_words_idx",
    "SELECT * FROM event_words_config",
    "SELECT * FROM event_facets",
    "SELECT position, run_id, seq, step, device FROM event_index ORDER BY position",
    "SELECT run_id, seq, actor, payload FROM events",
)
_NUMBERS = ("user_version", "application_id", "encoding")
WORDS = "event_words"  # the search index, whose tables have an internal structure


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict of `audit verify` on a record.

    Attributes:
        told: a fault was named, or the record was refused with an error.
        place: the fault names its place: a run, an event, a row or a file.
        noted: remarks other than faults that the unaltered record does not have.
        text: the first fault or the refusal; the traceback of a crash.
        crashed: it ended in an error outside our error tree.
    """

    told: bool
    place: bool = False
    noted: tuple[str, ...] = ()
    text: str = ""
    crashed: bool = False
    heads: Mapping[str, str] | None = None
    key_ids: tuple[str, ...] = ()


def verdict(record: Record, notes: tuple[str, ...], *, with_copy: bool = False, run_id: str | None = None) -> Verdict:
    """Verify the record in its current state; `notes` are those of the unaltered record."""
    try:
        report = audit.verify(record.data, run_id, signatures_copy=record.copy if with_copy else None)
    except OrthocaptureError as error:
        return Verdict(True, bool(error.where), text=f"{type(error).__name__}: {error}")
    except Exception:  # noqa: BLE001 - what this sweep is to find
        return Verdict(False, text=traceback.format_exc(limit=-4), crashed=True)
    placed = [fault for fault in report.faults if fault.run_id or fault.seq is not None or fault.file]
    noted = tuple(note for note in report.notes if note not in notes)
    text = str((placed or report.faults)[0]) if report.faults else ""
    return Verdict(bool(report.faults), bool(placed), noted, text, False, report.heads, report.key_ids)


@contextmanager
def quickened(*, files_stay: bool, database_stays: bool = False) -> Generator[None]:
    """Cache the answers of pure functions, such as hashes of equal texts and checks of equal signatures.

    Nothing else of the verification changes: the database and the signature log are read again each time, and so are
    the artefact files unless they cannot have changed (`files_stay`). The search index is compared again whenever the
    inputs of the comparison have changed (and never if `database_stays`).
    """
    payload_of: Any = vars(audit_checks)["_payload_of"]
    kept: dict[tuple[Any, ...], Any] = {}

    def remembered(row: Mapping[str, Any]) -> Any:
        key = tuple((name, type(value), value) for name, value in row.items())
        if key not in kept:
            kept[key] = payload_of(row)
        return kept[key]

    def file_hash(path: Path) -> tuple[str, int]:
        content = path.read_bytes()
        return _digest(content), len(content)

    file_state: Any = vars(file_checks)["_file_state"]
    with ExitStack() as stack:
        if files_stay:
            stack.enter_context(patch.object(file_checks, "_file_state", functools.cache(file_state)))
            unlisted = functools.cache(file_checks.unlisted_files)
            stack.enter_context(patch.object(audit, "unlisted_files", unlisted))
        stack.enter_context(
            patch.object(derived_checks, "content_faults", _remembered_contents(database_stays=database_stays))
        )
        gc.disable()
        stack.callback(gc.enable)
        for target, name, new in (
            (audit_checks, "_payload_of", remembered),
            (audit_signatures, "signed_by", functools.cache(audit_signatures.signed_by)),
            (LogLine, "signed_by", functools.cache(LogLine.signed_by)),
            (signature_log, "_line", functools.cache(vars(signature_log)["_line"])),
            (journal_lines, "parse_line", functools.cache(journal_lines.parse_line)),
            (database, "_engine", functools.cache(vars(database)["_engine"])),
            (file_checks, "hash_file", file_hash),
        ):
            stack.enter_context(patch.object(target, name, new))
        yield


def _remembered_contents(*, database_stays: bool) -> Callable[..., list[Fault]]:
    kept: dict[object, list[Fault]] = {}
    content_faults = derived_checks.content_faults

    def faults(connection: Connection, run_ids: Sequence[str], *, every_run: bool) -> list[Fault]:
        key: object = tuple(run_ids), every_run
        if not database_stays:
            read = [tuple(map(tuple, connection.exec_driver_sql(asked))) for asked in _CONTENTS_COME_FROM]
            key = key, tuple(read)
        if key not in kept:
            kept[key] = list(content_faults(connection, run_ids, every_run=every_run))
        return kept[key]

    return faults


@functools.lru_cache(maxsize=256)
def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


Content = Mapping[str, Any]


def content_of(data: Path) -> Content | str:
    """Read everything that SQLite reads from a database: all rows of all tables, the schema, and reported damage.

    Indexes are not read here: `damage_of` compares each of their entries with its row. Returns an error text if the
    database cannot be read.
    """
    found: dict[str, Any] = {}
    try:
        with closing(sqlite3.connect(f"file:{database_path(data)}?mode=ro", uri=True)) as connection:
            connection.text_factory = bytes
            for name in _NUMBERS:
                found[name] = connection.execute(f"PRAGMA {name}").fetchall()
            schema = connection.execute("SELECT type, name, tbl_name, sql FROM sqlite_master").fetchall()
            found["schema"] = schema
            for kind, name, _table, sql in schema:
                if kind == b"table" and not sql.upper().startswith(b"CREATE VIRTUAL"):
                    table = name.decode("ascii")
                    found[table] = connection.execute(f'SELECT * FROM "{table}"').fetchall()
    except (sqlite3.Error, UnicodeDecodeError, OverflowError) as error:
        return f"{type(error).__name__}: {error}"
    return found


def same_rows(one: Content, other: Content | str) -> bool:
    """Return whether both have the same rows.

    Their order within a table does not matter: where order counts, a column has it.
    """
    if isinstance(other, str) or one.keys() != other.keys():
        return False
    return all(sorted(map(repr, one[name])) == sorted(map(repr, other[name])) for name in one)


def damage_of(data: Path) -> str:
    """The result of SQLite's integrity_check: "ok", or the damage it finds."""
    try:
        with closing(sqlite3.connect(f"file:{database_path(data)}?mode=ro", uri=True)) as connection:
            return "\n".join(str(row[0]) for row in connection.execute("PRAGMA integrity_check"))
    except (sqlite3.Error, UnicodeDecodeError) as error:
        return f"{type(error).__name__}: {error}"


def columns_of(data: Path) -> dict[str, tuple[str, ...]]:
    """The column names of every table, in the order of `content_of`."""
    with closing(sqlite3.connect(f"file:{database_path(data)}?mode=ro", uri=True)) as connection:
        made = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
        names: dict[str, tuple[str, ...]] = {}
        for (table,) in made:
            names[table] = tuple(str(row[1]) for row in connection.execute(f'PRAGMA table_info("{table}")'))
        return names


def differences(before: Content, now: Content | str, columns: Mapping[str, tuple[str, ...]]) -> set[str]:
    """Return where the content differs: `table.column`, `table +row`, `table -row`, or a number of the database."""
    if isinstance(now, str):
        return {"unreadable"}
    places: set[str] = set()
    for name in before.keys() | now.keys():
        old, new = before.get(name), now.get(name)
        if old == new:
            continue
        if name not in columns or old is None or new is None:
            places.add(name)
            continue
        if len(old) != len(new):
            places.add(f"{name} {'+' if len(new) > len(old) else '-'}row")
            continue
        for one, other in zip(old, new, strict=True):
            places |= {f"{name}.{column}" for column, a, b in zip(columns[name], one, other, strict=True) if a != b}
    return places


def search_content(data: Path, terms: tuple[str, ...]) -> object:
    """The results of searches: the events of every word, and the positions of the words.

    Returns an error text if the database cannot be read.
    """
    try:
        with closing(sqlite3.connect(f"file:{database_path(data)}?mode=ro", uri=True)) as connection:
            connection.execute(f"CREATE VIRTUAL TABLE temp.words USING fts5vocab('main', '{WORDS}', 'instance')")
            places = connection.execute("SELECT term, doc, col, offset FROM temp.words").fetchall()
            ask = f"SELECT rowid FROM {WORDS} WHERE {WORDS} MATCH ? ORDER BY rowid"
            return places, [connection.execute(ask, (f'"{term}"',)).fetchall() for term in terms]
    except (sqlite3.Error, UnicodeDecodeError, OverflowError) as error:
        return f"{type(error).__name__}: {error}"


def search_terms(data: Path) -> tuple[str, ...]:
    """All words in the search index."""
    with closing(sqlite3.connect(f"file:{database_path(data)}?mode=ro", uri=True)) as connection:
        connection.execute(f"CREATE VIRTUAL TABLE temp.words USING fts5vocab('main', '{WORDS}', 'row')")
        return tuple(row[0] for row in connection.execute("SELECT term FROM temp.words"))
