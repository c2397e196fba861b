"""RO-Crate 1.1 metadata of a bundle: what is in it, who made it, with what, and what came from what."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from service.audit.bundle.contents import BundledRun, ManifestEntry
from service.core.gates import describe_accepted
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
from service.dataset.crate import CONTEXT, anchor, descriptor, device, file_entity, person, software
from service.store.events import canonical, references
from service.store.records import Artefact

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
