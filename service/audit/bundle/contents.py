"""What goes into a bundle: a run's records and files, read in one transaction and written one by one."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Table, select

from service.audit.bundle.readme import readme
from service.audit.bundle.zip_file import BundleZip, ManifestEntry
from service.audit.record.missing_results import not_in_yet
from service.core.errors import IntegrityError
from service.core.protocol.models import Protocol
from service.core.records.events import Event, RunStarted
from service.core.run.fold import fold
from service.core.run.state import RunState
from service.people.rows import full_names
from service.store.artefacts import chunks_of, read_artefacts
from service.store.database.tables import artefacts as artefact_table
from service.store.database.tables import events as event_table
from service.store.database.tables import jobs as job_table
from service.store.events import canonical, event_text, parse_canonical, read_events
from service.store.records import SITE, Artefact
from service.store.signatures.checkpoints import read_checkpoints, read_timestamps
from service.store.signatures.signing import PublicKey
from service.store.store import Store

Progress = Callable[[str, int, int], None]  # (activity, bytes done, bytes in total)
_EVENT = ("actor", "at_utc", "monotonic_s", "previous_sha256", "run_id", "seq", "sha256")
# Columns of the queue and the worker's lease, which are not evidence.
_NOT_OF_JOBS = (
    "position", "priority", "token", "until_utc_s", "host", "boot", "pid", "process_started_s",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class ChainHead:
    """The last event of a chain."""

    seq: int
    sha256: str
    at_utc: str


@dataclass(frozen=True, slots=True)
class BundledRun:
    """A run as one transaction sees it.

    Attributes:
        head: of the run's chain.
        site_head: of the site's chain.
        artefacts: every recorded file, once for each event that brought it.
        full_names: of accounts.
        missing: results that have not arrived yet, in words.
        keys: the site's public keys, oldest first.
    """

    run_id: str
    root: RunStarted
    head: ChainHead
    site_head: ChainHead
    events: Sequence[Event]
    state: RunState
    artefacts: Sequence[Artefact]
    full_names: Mapping[str, str]
    missing: Sequence[str]
    keys: Sequence[PublicKey]


def read_bundled_run(
    connection: Connection, run_id: str, protocol: Protocol, root: RunStarted, keys: Sequence[PublicKey]
) -> BundledRun:
    """Read what a bundle says about a run."""
    events = read_events(connection, run_id, 0)
    state = fold(protocol, events)
    return BundledRun(
        run_id=run_id,
        root=root,
        head=_head(connection, run_id),
        site_head=_head(connection, SITE),
        events=events,
        state=state,
        artefacts=read_artefacts(connection, run_id),
        full_names=full_names(connection),
        missing=not_in_yet(protocol, state, events),
        keys=keys,
    )


def write_records(bundle: BundleZip, store: Store, connection: Connection, run: BundledRun) -> None:
    """Write both chains, signatures, keys, jobs, the protocol, the rig, a README and the verifier."""
    run_id, root = run.run_id, run.root
    bundle.add("README.txt", [readme(run_id, run.keys[-1].key_id, root, run.missing).encode()])
    bundle.add("verify.py", [(files("service.audit.verify") / "bundle_verifier.py").read_bytes()])
    bundle.add("events.jsonl", _event_lines(connection, run_id))
    bundle.add("site_events.jsonl", _event_lines(connection, SITE))
    order = (artefact_table.c.seq, artefact_table.c.position)
    bundle.add("artefacts.jsonl", _lines(_rows(connection, artefact_table, run_id, order)))
    bundle.add("jobs.jsonl", _lines(map(_job, _rows(connection, job_table, run_id, (job_table.c.position,)))))
    signed = [*read_checkpoints(connection, SITE), *read_checkpoints(connection, run_id)]
    bundle.add("checkpoints.jsonl", _lines(asdict(checkpoint) for checkpoint in signed))
    stamped = [*read_timestamps(connection, SITE), *read_timestamps(connection, run_id)]
    bundle.add("timestamps.jsonl", _lines(asdict(stamp) for stamp in stamped))
    bundle.add("keys.jsonl", _lines(map(_key, run.keys)))
    for name, ref in (("protocol.yaml", root.protocol), ("rig.yaml", root.rig)):
        bundle.add(name, chunks_of(store.artefact_path(ref.sha256)))


def write_artefacts(bundle: BundleZip, store: Store, recorded: Iterable[Artefact], progress: Progress | None) -> None:
    """Copy every recorded file. Raises IntegrityError if one of them changed since it was verified."""
    sizes = {artefact.ref.sha256: artefact.ref.size_bytes for artefact in recorded}
    total, done = sum(sizes.values()), 0
    for sha256, size in sizes.items():
        path = store.artefact_path(sha256)
        listed = bundle.add(f"artefacts/{sha256[:2]}/{sha256}", chunks_of(path), compress=False)
        _require_same(listed, sha256, path)
        done += size
        if progress is not None:
            progress("copying files", done, total)


def _require_same(listed: ManifestEntry, sha256: str, path: Path) -> None:
    if listed.sha256 != sha256:
        raise IntegrityError(
            f"nothing is exported, because a file changed while it was copied: its SHA-256 is {listed.sha256}",
            where=str(path),
            remedy="Run `orthocapture audit verify`; restore the file from a copy",
        )


def _head(connection: Connection, run_id: str) -> ChainHead:
    last = select(event_table.c.seq, event_table.c.sha256, event_table.c.at_utc).where(event_table.c.run_id == run_id)
    row = connection.execute(last.order_by(event_table.c.seq.desc()).limit(1)).one()
    return ChainHead(row.seq, row.sha256, row.at_utc)


def _event_lines(connection: Connection, run_id: str) -> Iterator[bytes]:
    for row in _rows(connection, event_table, run_id, (event_table.c.seq,)):
        yield event_text({name: row[name] for name in _EVENT}, row["payload"]).encode() + b"\n"


def _rows(connection: Connection, table: Table, run_id: str, order: tuple[Any, ...]) -> Iterator[dict[str, Any]]:
    statement = select(table).where(table.c.run_id == run_id).order_by(*order)
    for row in connection.execution_options(yield_per=500).execute(statement).mappings():
        yield dict(row)


def _lines(records: Iterable[Mapping[str, Any]]) -> Iterator[bytes]:
    return (canonical(dict(record)).encode() + b"\n" for record in records)


def _job(row: Mapping[str, Any]) -> dict[str, Any]:
    kept = {name: value for name, value in row.items() if name not in _NOT_OF_JOBS}
    return kept | {"arguments": parse_canonical(row["arguments"])}


def _key(key: PublicKey) -> dict[str, Any]:
    return asdict(key) | {"public_key": base64.b64encode(key.public_key).decode()}
