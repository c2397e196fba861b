"""Export of a run's evidence as one file, with everything that a reader outside needs to verify it.

The site's whole chain is included, sign-ins too: only an unbroken chain shows that no key was slipped in, and that
the people who signed had the roles that they claimed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path

from service.audit.bundle_contents import (
    BundledRun,
    BundleZip,
    Progress,
    ZipTime,
    crate_json,
    read_bundled_run,
    write_artefacts,
    write_records,
    writing_bundle,
)
from service.core.errors import IntegrityError
from service.core.gates import refuse_export
from service.core.protocol import Protocol
from service.core.records.run_events import EvidenceExported, RunStarted
from service.core.run.fold import fold
from service.dataset.crate import METADATA
from service.run_start import recorded_run
from service.store.artefacts import hash_file
from service.store.disk_space import require_export_space
from service.store.events import canonical
from service.store.records import SITE
from service.store.signatures.signing import checkpoint, public_keys, sign
from service.store.store import Store
from service.store.verification.verify import AuditReport, verify

FORMAT = "orthocapture bundle v1"
MANIFEST_PREFIX = b"orthocapture bundle manifest v1\n"
MARK = "SIMULATED"


@dataclass(frozen=True, slots=True)
class WrittenBundle:
    """A bundle that was written and recorded."""

    path: Path
    sha256: str
    size_bytes: int
    head_seq: int  # last event of the run's chain in the bundle
    head_sha256: str
    key_id: str
    simulated: bool


@dataclass(frozen=True, slots=True)
class ExportableRun:
    """A run whose evidence verifies and that may be exported."""

    protocol: Protocol
    root: RunStarted
    audit: AuditReport


ReportMaker = Callable[[AuditReport, int], bytes]  # (result of the verification, last event) → HTML


def marked_name(name: str, *, simulated: bool) -> str:
    """Return the name of an exported file; for a simulated run it contains SIMULATED."""
    if not simulated or MARK in name:
        return name
    stem, dot, suffix = name.rpartition(".")
    return f"{stem}-{MARK}.{suffix}" if dot else f"{name}-{MARK}"


def require_exportable(
    store: Store, run_id: str, progress: Progress | None = None, *, unreleased: bool = False
) -> ExportableRun:
    """Verify the evidence with every file, and check that the run has been released if the protocol asks for it.

    With `unreleased`, for a report that says so, the release may be missing.

    Raises:
        IntegrityError: the evidence does not verify; it names the first fault.
        IllegalTransitionError: the protocol asks for a release that has not been given.
    """
    report = verify(store.database_path.parent, run_id, progress).with_limits()
    if report.first_fault is not None:
        raise IntegrityError(
            f"nothing is exported, because the evidence does not verify: {report.first_fault}",
            where=run_id,
            remedy="Run `orthocapture audit verify`, keep the folder as it is, and compare it with a copy",
        )
    protocol, root = recorded_run(store, run_id)
    refusal = None if unreleased else refuse_export(protocol, fold(protocol, store.events(run_id)))
    if refusal is not None:
        raise refusal
    return ExportableRun(protocol, root, report)


def record_export(
    store: Store, run_id: str, path: Path, *, file_name: str, what: str, head_sha256: str, actor: str
) -> tuple[str, int]:
    """Record in the run's chain that a file is exported, and sign the record. Returns hash and size of the file.

    Called before the file gets its name, so that no export can be unrecorded.
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
    """Write a run's bundle and record the export. That record holds the bundle's hash and so is not in the bundle.

    Args:
        store: the data folder.
        run_id: the run.
        target: the file, which must not exist; for a simulated run, SIMULATED is added to its name.
        actor: the person who exports.
        hashes_only: leave out the recorded files; their hashes are in the records.
        report: makes an HTML report to be included.
        progress: a function that is called with the activity, the bytes done and the total.

    Raises:
        IntegrityError: the evidence does not verify. Nothing was written.
        IllegalTransitionError: the run has not been released. Nothing was written.
        DataError: the file exists.
        SpaceShortError: the bundle would use the space that is reserved for the evidence. Nothing was written.
        StoreError: the disk refused, or the signing key cannot be used.
    """
    if not hashes_only:
        require_export_space(store, run_id, target)
    exportable = require_exportable(store, run_id, progress)
    root = exportable.root
    target = target.with_name(marked_name(target.name, simulated=root.simulated))
    checkpoint(store, run_id)
    checkpoint(store, SITE)
    keys = public_keys(store)
    with store.database.reading() as connection:
        run = read_bundled_run(connection, run_id, exportable.protocol, keys)
        left: list[tuple[str, int]] = []

        def leave(part: Path) -> None:
            named = {"file_name": target.name, "what": "bundle", "head_sha256": run.head.sha256}
            left.append(record_export(store, run_id, part, **named, actor=actor))

        with writing_bundle(target, _zip_time(run.head.at_utc), leave) as bundle:
            write_records(bundle, store, connection, run)
            if report is not None:
                if progress is not None:
                    progress("writing the report", 0, 0)
                bundle.add("report.html", [report(exportable.audit, run.head.seq)])
            if not hashes_only:
                write_artefacts(bundle, store, run.artefacts, progress)
            bundle.add(METADATA, [crate_json(run, bundle.listed)])
            key_id = _add_manifest(bundle, store, run, hashes_only=hashes_only)
    ((sha256, size),) = left
    return WrittenBundle(target, sha256, size, run.head.seq, run.head.sha256, key_id, root.simulated)


def _add_manifest(bundle: BundleZip, store: Store, run: BundledRun, *, hashes_only: bool) -> str:
    """Write the list of all files and its signature; the key's fingerprint. Raises IntegrityError, StoreError."""
    manifest = {
        "format": FORMAT,
        "run_id": run.run_id,
        "simulated": run.root.simulated,
        "hashes_only": hashes_only,
        "head": {"seq": run.head.seq, "sha256": run.head.sha256},
        "site_head": {"seq": run.site_head.seq, "sha256": run.site_head.sha256},
        "made_by_key": run.keys[-1].key_id,
        "software": run.root.software.get("orthocapture", ""),
        "files": [asdict(item) for item in bundle.listed],
    }
    signed = canonical(manifest).encode()
    key_id, signature = sign(store, MANIFEST_PREFIX + signed)
    if key_id != run.keys[-1].key_id:
        raise IntegrityError("the signing key was changed meanwhile", where=run.run_id, remedy="Export again")
    bundle.add("manifest.json", [signed])
    bundle.add("manifest.sig", [signature.encode() + b"\n"])
    return key_id


def _zip_time(at_utc: str) -> ZipTime:
    """Return the time of the last event, so that the same evidence gives the same bytes; zip has no odd seconds."""
    year, month, day = (int(part) for part in at_utc[:10].split("-"))
    hour, minute, second = (int(part) for part in at_utc[11:19].split(":"))
    return max(year, 1980), month, day, hour, minute, second - second % 2


def bundle_report(data: Path, run_id: str, *, with_pictures: bool) -> Callable[[AuditReport, int], bytes]:
    """Return a function that makes the HTML report of a run up to an event from the result of its verification.

    The report is dated by the last event in the bundle, so that the same evidence gives the same bytes.
    """

    def make(audit: AuditReport, last_seq: int) -> bytes:
        # Imported here because numerics, pictures and the 3D scene take long to load, and only the report needs them.
        from service.audit.recorded_run import read_run  # noqa: PLC0415
        from service.audit.report import report_content  # noqa: PLC0415
        from service.audit.report_output import render_html  # noqa: PLC0415

        run = read_run(data, run_id, last_seq=last_seq)
        made_at = datetime.fromisoformat(run.events[-1].at_utc)
        report = report_content(run, audit, made_at=made_at, with_scene=with_pictures, with_pictures=with_pictures)
        return render_html(report).encode()

    return make
