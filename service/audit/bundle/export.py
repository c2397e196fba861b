"""The evidence of a run as one file for somebody outside, with everything that is needed to verify it there.

The site's chain goes along whole, sign-ins included: only an unbroken chain shows that no key was slipped in, and
that the people who signed had the roles they had.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Table, select

from service.audit.bundle.crate import METADATA, crate
from service.audit.bundle.zip_file import BundleZip, ManifestEntry, ZipTime, writing_bundle
from service.audit.record.missing_results import not_in_yet
from service.core.errors import IntegrityError
from service.core.gates.release import refuse_export
from service.core.protocol.models import Protocol
from service.core.records.events import EvidenceExported, RunStarted
from service.core.run.fold import fold
from service.people.rows import full_names
from service.run_start import recorded_run
from service.store.database.tables import artefacts as artefact_table
from service.store.database.tables import events as event_table
from service.store.database.tables import jobs as job_table
from service.store.events import canonical, event_text, parse_canonical, read_events
from service.store.files.artefacts import chunks_of, hash_file, read_artefacts
from service.store.files.space_used import require_export_space
from service.store.records import SITE, Artefact
from service.store.signatures.checkpoints import read_checkpoints, read_timestamps
from service.store.signatures.signing import PublicKey, checkpoint, public_keys, sign
from service.store.store import Store
from service.store.verification.verify import AuditReport, verify

FORMAT = "orthocapture bundle v1"
MANIFEST_PREFIX = b"orthocapture bundle manifest v1\n"
MARK = "SIMULATED"
_EVENT = ("actor", "at_utc", "monotonic_s", "previous_sha256", "run_id", "seq", "sha256")
_NOT_OF_JOBS = (
    "position",
    "priority",
    "token",
    "until_utc_s",
    "host",
    "boot",
    "pid",
    "process_started_s",
)  # a lease's, not evidence

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class WrittenBundle:
    """A bundle as it was written and recorded."""

    path: Path
    sha256: str
    size_bytes: int
    head_seq: int  # of the run's chain in it
    head_sha256: str
    key_id: str
    simulated: bool


@dataclass(frozen=True, slots=True)
class ExportableRun:
    """A run whose evidence verifies and that may leave."""

    protocol: Protocol
    root: RunStarted
    audit: AuditReport


ReportMaker = Callable[[AuditReport, int], bytes]  # from what verifying gave; up to this event


@dataclass(frozen=True, slots=True)
class _ChainHead:
    seq: int
    sha256: str
    at_utc: str


def marked_name(name: str, *, simulated: bool) -> str:
    """The name of an exported file; that of a simulated run says so."""
    if not simulated or MARK in name:
        return name
    stem, dot, suffix = name.rpartition(".")
    return f"{stem}-{MARK}.{suffix}" if dot else f"{name}-{MARK}"


def require_exportable(store: Store, run_id: str, progress: Progress | None = None) -> ExportableRun:
    """Verify the evidence, every file included, and that people have released it.

    Raises:
        IntegrityError: the evidence does not verify; it names the first fault.
        IllegalTransitionError: the protocol asks for a release that has not been given.
    """
    report = verify(store.database_path.parent, run_id, progress)
    if report.first_fault is not None:
        raise IntegrityError(
            f"nothing is exported, because the evidence does not verify: {report.first_fault}",
            where=run_id,
            remedy="Run `orthocapture audit verify`, keep the folder as it is, and compare it with a copy",
        )
    protocol, root = recorded_run(store, run_id)
    refusal = refuse_export(protocol, fold(protocol, store.events(run_id)))
    if refusal is not None:
        raise refusal
    return ExportableRun(protocol, root, report)


def record_export(
    store: Store, run_id: str, path: Path, *, file_name: str, what: str, head_sha256: str, actor: str
) -> tuple[str, int]:
    """Write down in the run's chain that a file leaves, and sign that. Hash and size of the file.

    Called while the file still has another name, so that nothing leaves that is not recorded.
    """
    sha256, size = hash_file(path)
    payload = EvidenceExported.model_validate(
        {
            "what": what,
            "file_name": file_name,
            "sha256": sha256,
            "size_bytes": size,
            "head_sha256": head_sha256,
        }
    )
    store.record(run_id, [payload], actor=actor)
    checkpoint(store, run_id)
    return sha256, size


def export_bundle(
    store: Store,
    run_id: str,
    target: Path,
    *,
    actor: str,
    hashes_only: bool = False,
    report: ReportMaker | None = None,
    progress: Progress | None = None,
) -> WrittenBundle:
    """Write a run's bundle and record that it was exported. That record is not in the bundle: it tells its hash.

    Args:
        store: the data folder.
        run_id: the run.
        target: the file, which must not exist; a simulated run's gets SIMULATED into its name.
        actor: who exports.
        hashes_only: leave the recorded files out; their hashes are in the records.
        report: makes a report for people (HTML) that goes along.
        progress: told what is being done, in bytes.

    Raises:
        IntegrityError: the evidence does not verify. Nothing was written.
        IllegalTransitionError: the run has not been released. Nothing was written.
        DataError: the file exists.
        SpaceShortError: the bundle would take the room that is kept for the evidence. Nothing was written.
        StoreError: the disk refused, or the signing key cannot be used.
    """
    if not hashes_only:
        require_export_space(store, run_id, target)
    exportable = require_exportable(store, run_id, progress)
    protocol, root = exportable.protocol, exportable.root
    target = target.with_name(marked_name(target.name, simulated=root.simulated))
    checkpoint(store, run_id)
    checkpoint(store, SITE)
    keys = public_keys(store)
    with store.database.reading() as connection:
        head, site_head = _head(connection, run_id), _head(connection, SITE)
        left: list[tuple[str, int]] = []

        def leave(part: Path) -> None:
            named = {"file_name": target.name, "what": "bundle", "head_sha256": head.sha256}
            left.append(record_export(store, run_id, part, **named, actor=actor))

        with writing_bundle(target, _zip_time(head.at_utc), leave) as bundle:
            recorded = read_artefacts(connection, run_id)
            events = read_events(connection, run_id, 0)
            state = fold(protocol, events)
            missing = not_in_yet(protocol, state, events)
            _write_records(bundle, store, connection, run_id, root, keys, missing)
            if report is not None:
                if progress is not None:
                    progress("writing the report", 0, 0)
                bundle.add("report.html", [report(exportable.audit, head.seq)])
            if not hashes_only:
                _write_artefacts(bundle, store, recorded, progress)
            names = full_names(connection)
            metadata = crate(run_id, root, state, events, recorded, bundle.listed, names, missing)
            bundle.add(METADATA, [canonical(metadata).encode()])
            manifest = {
                "format": FORMAT,
                "run_id": run_id,
                "simulated": root.simulated,
                "hashes_only": hashes_only,
                "head": {"seq": head.seq, "sha256": head.sha256},
                "site_head": {"seq": site_head.seq, "sha256": site_head.sha256},
                "made_by_key": keys[-1].key_id,
                "software": root.software.get("orthocapture", ""),
                "files": [asdict(item) for item in bundle.listed],
            }
            signed = canonical(manifest).encode()
            key_id, signature = sign(store, MANIFEST_PREFIX + signed)
            if key_id != keys[-1].key_id:
                raise IntegrityError("the signing key was changed meanwhile", where=run_id, remedy="Export again")
            bundle.add("manifest.json", [signed])
            bundle.add("manifest.sig", [signature.encode() + b"\n"])
    ((sha256, size),) = left
    return WrittenBundle(target, sha256, size, head.seq, head.sha256, key_id, root.simulated)


def _write_records(
    bundle: BundleZip,
    store: Store,
    connection: Connection,
    run_id: str,
    root: RunStarted,
    keys: list[PublicKey],
    missing: Sequence[str],
) -> None:
    readme = _readme(run_id, keys[-1].key_id, root, missing)
    bundle.add("README.txt", [readme.encode()])
    bundle.add("verify.py", [(files("service.audit.verify") / "bundle_verifier.py").read_bytes()])
    bundle.add("events.jsonl", _event_lines(connection, run_id))
    bundle.add("site_events.jsonl", _event_lines(connection, SITE))
    order = (artefact_table.c.seq, artefact_table.c.position)
    bundle.add("artefacts.jsonl", _lines(_rows(connection, artefact_table, run_id, order)))
    bundle.add("jobs.jsonl", _lines(map(_job, _rows(connection, job_table, run_id, (job_table.c.position,)))))
    signed = [*read_checkpoints(connection, SITE), *read_checkpoints(connection, run_id)]
    bundle.add("checkpoints.jsonl", _lines(map(asdict, signed)))
    stamped = [*read_timestamps(connection, SITE), *read_timestamps(connection, run_id)]
    bundle.add("timestamps.jsonl", _lines(map(asdict, stamped)))
    bundle.add("keys.jsonl", _lines(map(_key, keys)))
    for name, ref in (("protocol.yaml", root.protocol), ("rig.yaml", root.rig)):
        bundle.add(name, chunks_of(store.artefact_path(ref.sha256)))


def _write_artefacts(
    bundle: BundleZip, store: Store, recorded: Iterable[Artefact], progress: Progress | None
) -> None:
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


def _head(connection: Connection, run_id: str) -> _ChainHead:
    last = select(event_table.c.seq, event_table.c.sha256, event_table.c.at_utc).where(event_table.c.run_id == run_id)
    row = connection.execute(last.order_by(event_table.c.seq.desc()).limit(1)).one()
    return _ChainHead(row.seq, row.sha256, row.at_utc)


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


def _zip_time(at_utc: str) -> ZipTime:
    """Of the last event, so that the same evidence gives the same bytes; zip knows no odd seconds."""
    year, month, day = (int(part) for part in at_utc[:10].split("-"))
    hour, minute, second = (int(part) for part in at_utc[11:19].split(":"))
    return max(year, 1980), month, day, hour, minute, second - second % 2


def _readme(run_id: str, key_id: str, root: RunStarted, missing: Sequence[str]) -> str:
    warning = (
        "SIMULATED: no real device took part in this run. It is no record of a real acquisition.\n\n"
        if root.simulated
        else ""
    )
    if root.origin == "imported":
        warning += (
            "IMPORTED: how the images were captured is not in evidence, only when and by whom they were imported.\n\n"
        )
    if missing:
        warning += (
            "NOT IN YET: when this bundle was made, these results had not arrived. "
            f"A later export has those that came.\n{''.join(f'  - {line}{chr(10)}' for line in missing)}\n"
        )
    return f"""Evidence of run {run_id}, exported by orthocapture

{warning}To verify this bundle, on any machine with Python 3.9 or newer and the package `cryptography`, offline:

    python verify.py BUNDLE.zip --key FINGERPRINT

FINGERPRINT is that of the site's signing key, as the site told it to you in another way than with this bundle
(`orthocapture audit keys` shows it there). This bundle says that it is
{key_id}
A verifier that came with what it verifies could be forged as well: take verify.py from an installation or a release
of orthocapture that you trust (service/audit/verify/bundle_verifier.py, the same file byte for byte).

events.jsonl        everything that happened in the run: who, what, when (UTC and monotonic), one record a line.
                    sha256 is SHA-256 over the RFC 8785 canonical JSON of the other fields; previous_sha256 links
                    them.
site_events.jsonl   the same for the site: accounts and their roles, sign-ins, signing keys, starts of the service. It
                    is here as a whole, because only an unbroken chain shows that no key was slipped in.
checkpoints.jsonl   Ed25519 signatures; each covers every event and every artefact row up to its own event.
timestamps.jsonl    what time-stamp authorities say of checkpoints (RFC 3161), if any.
keys.jsonl          the public keys, oldest first; each signed its successor as its last act.
artefacts.jsonl     where each recorded file came from; the files are artefacts/ab/ab… named by their SHA-256.
jobs.jsonl          computations.
protocol.yaml, rig.yaml     as they were when the run began.
report.html         the same for people, made from the records above; it tells the chain up to the same event. Open it
                    in a browser; it needs no network.
ro-crate-metadata.json      the same for machines (RO-Crate 1.1).
manifest.json, manifest.sig every file with its hash, and the signature over that list.

What this proves: nothing was changed since the site's key signed it. What it cannot prove: that the people and
devices told the truth, or that nobody but the site had the key.
"""
