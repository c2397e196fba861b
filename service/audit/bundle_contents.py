"""Reads what goes into a bundle in one transaction, streams it into a zip file, and describes it as an RO-Crate."""

from __future__ import annotations

import base64
import hashlib
import os
import stat
import zipfile
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Table, select

from service.audit.recorded_run import not_in_yet
from service.core.errors import DataError, IntegrityError, StoreError
from service.core.gates import describe_accepted
from service.core.protocol import Protocol
from service.core.recorded_devices import bodies, recorded_report
from service.core.records.base import ArtefactRef
from service.core.records.events import Event
from service.core.records.import_list import imported_sentence
from service.core.records.run_events import (
    DeviceOpened,
    JobEnqueued,
    JobFinished,
    RunStarted,
    ViewHeld,
    ViewImported,
    ViewpointCaptured,
)
from service.core.run.fold import FoldedRun, fold
from service.dataset.crate import CONTEXT, anchor, descriptor, device, file_entity, person, software
from service.people.person import full_names
from service.store.artefacts import chunks_of, read_artefacts
from service.store.database.tables import artefacts as artefact_table
from service.store.database.tables import events as event_table
from service.store.database.tables import jobs as job_table
from service.store.durable_effects import DurableFiles
from service.store.events import canonical, event_text, parse_canonical, read_events, references
from service.store.records import SITE, Artefact
from service.store.signatures.checkpoints import read_checkpoints, read_timestamps
from service.store.signatures.signing import PublicKey
from service.store.store import Store

ZipTime = tuple[int, int, int, int, int, int]


@dataclass(frozen=True, slots=True)
class ManifestEntry:
    """A file of the bundle, as the manifest lists it."""

    path: str
    sha256: str
    size_bytes: int


class BundleZip:
    """A zip file that is being written; every entry is hashed on the way."""

    def __init__(self, archive: zipfile.ZipFile, at: ZipTime) -> None:
        self._archive = archive
        self._at = at
        self.listed: list[ManifestEntry] = []

    def add(self, path: str, chunks: Iterable[bytes], *, compress: bool = True) -> ManifestEntry:
        """Write one file. Images are stored without compression."""
        info = zipfile.ZipInfo(path, date_time=self._at)
        info.compress_type = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
        info.create_system = 3  # Unix on every machine, so that the permissions below count
        info.external_attr = (stat.S_IFREG | 0o644) << 16
        digest, size = hashlib.sha256(), 0
        with self._archive.open(info, "w", force_zip64=True) as entry:
            for chunk in chunks:
                digest.update(chunk)
                size += len(chunk)
                entry.write(chunk)
        listed = ManifestEntry(path, digest.hexdigest(), size)
        self.listed.append(listed)
        return listed


@contextmanager
def writing_bundle(target: Path, at: ZipTime, leaving: Callable[[Path], None] | None = None) -> Generator[BundleZip]:
    """Yield a zip file that gets its name only when it is complete and durable; otherwise nothing is left of it.

    Args:
        target: the file.
        at: time stamp of its entries.
        leaving: a function called with the complete file before it gets its name; if it raises, no file appears.

    Raises:
        DataError: a file of this name exists.
        StoreError: the disk refused.
    """
    if target.exists():
        raise DataError("the file exists already", where=str(target), remedy="Name a new one; nothing is overwritten")
    part = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        with part.open("xb") as handle:
            with zipfile.ZipFile(handle, "w", allowZip64=True) as archive:
                yield BundleZip(archive, at)
            handle.flush()
            os.fsync(handle.fileno())
        if leaving is not None:
            leaving(part)
        os.link(part, target)  # unlike a rename, it never replaces a file that another process has made meanwhile
        DurableFiles().sync_directory(target.parent)
    except FileExistsError as error:
        raise DataError("the file exists already", where=str(target), remedy="Name a new one") from error
    except OSError as error:
        raise StoreError(
            f"the bundle cannot be written: {error.strerror or error}",
            where=str(error.filename or target),
            remedy="Check free space and permissions; the evidence is unchanged",
        ) from error
    finally:
        part.unlink(missing_ok=True)


_TEXT = """Evidence of run {run_id}, exported by orthocapture

{warnings}To verify this bundle, on any machine with Python 3.9 or newer and the package `cryptography`, offline:

    python -I verify.py BUNDLE.zip --key FINGERPRINT

With -I, Python takes no module from beside verify.py in place of its own.
FINGERPRINT is the fingerprint of the site's signing key. Ask the site for it; do not take it from this bundle. The
site sees it with `orthocapture audit keys`. This bundle states that it is
{key_id}
A verifier that comes with what it verifies could be forged as well. Take verify.py from an installation or a release
of orthocapture that you trust (service/audit/bundle_verifier.py, the same file byte for byte).

events.jsonl        everything that happened in the run: who, what, when (UTC and monotonic), one record per line.
                    sha256 is SHA-256 over the RFC 8785 canonical JSON of the other fields; previous_sha256 links
                    the records to a chain.
site_events.jsonl   the chain of the site: accounts and their roles, sign-ins, signing keys, starts of the service. It
                    is complete, because only an unbroken chain shows that no key was slipped in.
checkpoints.jsonl   Ed25519 signatures; each covers every event and every artefact row up to its own event.
timestamps.jsonl    time stamps (RFC 3161) that authorities gave for checkpoints, if any.
keys.jsonl          the public keys, oldest first; each signed its successor as its last act.
artefacts.jsonl     where each recorded file came from; the files are artefacts/ab/ab… named by their SHA-256.
jobs.jsonl          the computations and their arguments.
protocol.yaml, rig.yaml     as they were when the run began.
report.html         a report for people, made from these records up to the last event in this bundle. Open it in a
                    browser; it needs no network.
ro-crate-metadata.json      a description of this bundle for machines (RO-Crate 1.1).
manifest.json, manifest.sig every file with its hash, and the signature over that list.

What this proves: nothing was changed after the site's key signed it. What it cannot prove: that the people and
devices told the truth, or that nobody but the site had the key.
"""


def readme(run_id: str, key_id: str, root: RunStarted, missing: Sequence[str]) -> str:
    """Return the text of README.txt.

    Args:
        run_id: the run's identifier.
        key_id: fingerprint of the site's signing key.
        root: the run's first event.
        missing: texts on results that have not arrived yet.
    """
    return _TEXT.format(run_id=run_id, key_id=key_id, warnings=_warnings(root, missing))


def _warnings(root: RunStarted, missing: Sequence[str]) -> str:
    """Return paragraphs on a simulated rig, imported images and missing results; each ends with an empty line."""
    found: list[str] = []
    if root.simulated:
        found.append("SIMULATED: no real device took part in this run. It is not a record of a real acquisition.")
    if root.origin == "imported":
        found.append(
            "IMPORTED: how the images were captured is not in evidence, only when and by whom they were imported."
        )
    if missing:
        lines = "".join(f"\n  - {line}" for line in missing)
        found.append(
            "NOT IN YET: when this bundle was made, these results had not arrived. A later export has those that "
            f"came.{lines}"
        )
    return "".join(f"{text}\n\n" for text in found)


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
class BundledRun(FoldedRun):
    """A run as one transaction sees it.

    Attributes:
        head: the head of the run's chain.
        site_head: the head of the site's chain.
        artefacts: every recorded file, once for each event that brought it.
        full_names: people's full names, by account.
        missing: texts on results that have not arrived yet.
        keys: the site's public keys, oldest first.
    """

    head: ChainHead
    site_head: ChainHead
    artefacts: Sequence[Artefact]
    full_names: Mapping[str, str]
    missing: Sequence[str]
    keys: Sequence[PublicKey]


def read_bundled_run(
    connection: Connection, run_id: str, protocol: Protocol, keys: Sequence[PublicKey]
) -> BundledRun:
    """Read what a bundle says about a run."""
    events = read_events(connection, run_id, 0)
    state = fold(protocol, events)
    return BundledRun(
        run_id=run_id,
        protocol=protocol,
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
    bundle.add("verify.py", [(files("service.audit") / "bundle_verifier.py").read_bytes()])
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
    with connection.execution_options(yield_per=500).execute(statement) as rows:
        for row in rows.mappings():
            yield dict(row)


def _lines(records: Iterable[Mapping[str, Any]]) -> Iterator[bytes]:
    return (canonical(dict(record)).encode() + b"\n" for record in records)


def _job(row: Mapping[str, Any]) -> dict[str, Any]:
    kept = {name: value for name, value in row.items() if name not in _NOT_OF_JOBS}
    return kept | {"arguments": parse_canonical(row["arguments"])}


def _key(key: PublicKey) -> dict[str, Any]:
    return asdict(key) | {"public_key": base64.b64encode(key.public_key).decode()}


# --- RO-Crate 1.1: what is in the bundle, who made it, with what, and what came from what -------------------------

_DESCRIPTIONS = {
    "README.txt": "How to read and verify this bundle",
    "events.jsonl": "The run's chain of events: one canonical JSON record a line",
    "site_events.jsonl": "The site's chain: accounts, sign-ins, signing keys, starts of the service",
    "artefacts.jsonl": "Where each recorded file came from",
    "jobs.jsonl": "Computations",
    "checkpoints.jsonl": "Ed25519 signatures over both chains",
    "timestamps.jsonl": "RFC 3161 time stamps of checkpoints",
    "keys.jsonl": "Public keys of the site, oldest first",
    "protocol.yaml": "The protocol with which the run began",
    "rig.yaml": "The rig with which the run began",
    "report.html": "Report for people",
    "verify.py": "Stand-alone verifier",
}


def crate_json(run: BundledRun, files: Sequence[ManifestEntry]) -> bytes:
    """Return the metadata as canonical JSON. `files`: those in the bundle, which may lack recorded files."""
    described = _artefact_entities(run.artefacts, {item.path for item in files})
    ids = {artefact.ref.sha256: entity["@id"] for artefact, entity in described}
    own = [
        file_entity(item.path, item.sha256, item.size_bytes, _DESCRIPTIONS.get(item.path, ""))
        for item in files
        if not item.path.startswith("artefacts/")
    ]
    parts = [*own, *(entity for _, entity in described)]
    named = sorted({*run.state.people, *filter(None, (run.root.operator, run.state.released_by))})
    people = [person(name, run.full_names) for name in named]
    devices = list(_devices(run.events))
    actions = [*_captures(run.events, ids, {d["@id"] for d in devices}), *_jobs(run.events, ids)]
    dataset = _dataset(run) | {
        "author": [{"@id": one["@id"]} for one in people],
        "hasPart": [{"@id": part["@id"]} for part in parts if part["@type"] == "File"],
        "mentions": [{"@id": item["@id"]} for item in (*(p for p in parts if p["@type"] != "File"), *actions)],
    }
    graph = [*_about(run.root, dataset), *people, *devices, *parts, *actions]
    return canonical({"@context": CONTEXT, "@graph": graph}).encode()


def _dataset(run: BundledRun) -> dict[str, Any]:
    root = run.root
    marked = "SIMULATED " if root.simulated else ""
    accepted = [f"{name}: {describe_accepted(s.accepted)}" for name, s in run.state.steps.items() if s.accepted]
    return {
        "@id": "./",
        "@type": "Dataset",
        "name": f"{marked}Evidence of run {run.run_id}",
        "description": (
            f"{marked}Evidence of {root.protocol_id} {root.protocol_version}: every event, signature and file."
            + (" No real device took part: the whole rig was simulated." if root.simulated else "")
            + (f" {imported_sentence(run.events[0].at_utc, root.operator)}." if root.origin == "imported" else "")
            + "".join(f" Accepted outside its limits: {text}." for text in accepted)
            + (f" Not in when this was made: {'; '.join(run.missing)}." if run.missing else "")
        ),
        "datePublished": run.events[-1].at_utc,
        "license": {"@id": "#rights"},
        "keywords": ["simulated"] if root.simulated else [],
    }


def _about(root: RunStarted, dataset: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the metadata file, the data set, the rights and the software, in the order of the graph."""
    return [
        descriptor(),
        dataset,
        {
            "@id": "#rights",
            "@type": "CreativeWork",
            "name": "Rights",
            "description": "This bundle grants none; ask the site that made it.",
        },
        software(root.software.get("orthocapture", "unknown")),
    ]


def _artefact_entities(artefacts: Iterable[Artefact], present: set[str]) -> list[tuple[Artefact, dict[str, Any]]]:
    """Describe each distinct content once. Recorded files that are not in the bundle are not of type File."""
    found: dict[str, tuple[Artefact, dict[str, Any]]] = {}
    for artefact in artefacts:
        ref = artefact.ref
        path = f"artefacts/{ref.sha256[:2]}/{ref.sha256}"
        entity = {
            "@id": path if path in present else f"#artefact-{ref.sha256}",
            "@type": "File" if path in present else "CreativeWork",
            "name": ref.original_name,
            "additionalType": ref.kind,
            "encodingFormat": ref.media_type,
            "contentSize": str(ref.size_bytes),
            "sha256": ref.sha256,
            "dateCreated": artefact.at_utc,
        }
        found.setdefault(ref.sha256, (artefact, entity))
    return list(found.values())


def _devices(events: Sequence[Event]) -> Iterable[dict[str, Any]]:
    """Yield every device as it first answered."""
    opened: dict[str, DeviceOpened] = {}
    for event in events:
        if isinstance(event.payload, DeviceOpened):
            opened.setdefault(event.payload.device, event.payload)
    known = bodies(events)
    for name, payload in opened.items():
        identity = recorded_report(payload.report).identity
        entity = device(name, identity.model, identity.firmware, known.shown(identity))
        # As its connection states it, where photographs state the body's own: one camera.
        yield entity | ({"identifier": identity.serial} if known.shown(identity) != identity.serial else {})


def _captures(events: Sequence[Event], ids: Mapping[str, str], devices: set[str]) -> Iterable[dict[str, Any]]:
    camera = anchor("device", "camera")
    for event in events:
        payload = event.payload
        if isinstance(payload, (ViewpointCaptured, ViewHeld)):
            yield {
                "@id": f"#event-{event.seq}",
                "@type": "CreateAction",
                "name": f"Capture of {payload.viewpoint}, attempt {payload.attempt} of {payload.step}",
                "instrument": [{"@id": camera if camera in devices else "#software"}],
                "endTime": event.at_utc,
                "result": _links(payload.artefacts, ids),
            }
        elif isinstance(payload, ViewImported):
            yield {
                "@id": f"#event-{event.seq}",
                "@type": "CreateAction",
                "name": f"Import of {payload.file_name} as {payload.viewpoint} in {payload.step}",
                "description": "How the photograph was captured is not in evidence.",
                "agent": {"@id": anchor("person", payload.imported_by)},
                "instrument": [{"@id": "#software"}],
                "endTime": event.at_utc,
                "result": _links(payload.artefacts, ids),
            }


def _jobs(events: Sequence[Event], ids: Mapping[str, str]) -> Iterable[dict[str, Any]]:
    enqueued = {e.payload.job: e for e in events if isinstance(e.payload, JobEnqueued)}
    for event in events:
        payload = event.payload
        if not isinstance(payload, JobFinished):
            continue
        begun = enqueued.get(payload.job)
        arguments = begun.payload.arguments if begun is not None and isinstance(begun.payload, JobEnqueued) else {}
        yield {
            "@id": anchor("job", payload.job),
            "@type": "CreateAction",
            "name": f"{payload.job_kind} for {payload.step}",
            "instrument": {"@id": "#software"},
            "startTime": event.at_utc if begun is None else begun.at_utc,
            "endTime": event.at_utc,
            "actionStatus": {"@id": "http://schema.org/CompletedActionStatus"},
            "object": _named(arguments, ids),
            "result": _links(payload.artefacts, ids),
        }


def _links(refs: Iterable[ArtefactRef], ids: Mapping[str, str]) -> list[dict[str, str]]:
    return [{"@id": ids[ref.sha256]} for ref in refs if ref.sha256 in ids]


def _named(arguments: Mapping[str, Any], ids: Mapping[str, str]) -> list[dict[str, str]]:
    """Return the recorded files that a job's arguments name, as references or by their hash alone."""
    found = {ref.sha256: None for ref in references(arguments)} | dict.fromkeys(_hashes(arguments, ids))
    return [{"@id": ids[sha256]} for sha256 in found if sha256 in ids]


def _hashes(value: object, ids: Mapping[str, str]) -> Iterable[str]:
    if isinstance(value, str) and value in ids:
        yield value
    elif isinstance(value, Mapping):
        for item in value.values():
            yield from _hashes(item, ids)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _hashes(item, ids)
