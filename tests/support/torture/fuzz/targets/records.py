"""Fuzz targets for records: signatures, bundles, time stamps, keys, events, snapshots and web forms."""

from __future__ import annotations

import atexit
import base64
import contextlib
import json
import os
import shutil
import tempfile
import urllib.request
import zipfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from rfc3161_client import HashAlgorithm, TimestampRequestBuilder

from service.audit import bundle_verifier
from service.audit.bundle import export_bundle
from service.audit.verifications import Verifications
from service.monitor.snapshot import Snapshot, read_snapshot, write_snapshot
from service.store.durable_effects import DurableFiles, SystemClock
from service.store.events import to_event
from service.store.records import Checkpoint, Timestamp
from service.store.signatures.checkpoints import KeyFolder, key_fingerprint, public_bytes
from service.store.signatures.log import NAME, log_findings, read_log
from service.store.signatures.second_place import LogCopy
from service.store.signatures.signing import checkpoint, rotate_key
from service.store.signatures.timestamps import stamped_bytes, timestamp_findings
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.web import Browser, web_site
from tests.support.record.time_stamp_authority import time_stamp_authority
from tests.support.runs.bench_run import PROTOCOL, begin_run
from tests.support.torture.fuzz.mutations import BYTES, JSON, TEXT
from tests.support.torture.fuzz.targets.target import MisbehavedError, Target

MEMBERS = ("manifest.json", "events.jsonl", "site_events.jsonl", "artefacts.jsonl", "jobs.jsonl", "checkpoints.jsonl",
           "keys.jsonl", "ro-crate-metadata.json", "manifest.sig")  # fmt: skip


@dataclass(frozen=True)
class _Recorded:
    """A data folder with a completed run, and its bundle, packed and unpacked."""

    data: Path
    run_id: str
    bundle: Path
    unpacked: Path
    certificates: Path
    token: bytes
    stamped: Checkpoint


@cache
def _recorded() -> _Recorded:
    """The recorded data, made once per process in a folder that is deleted with its TMPDIR."""
    folder = Path(tempfile.mkdtemp(prefix="recorded-", dir=os.environ.get("TMPDIR")))
    with Store.open(folder / "data") as store:
        bench = begin_run(store, PROTOCOL, folder)
        bench.run()
        signed = checkpoint(store, bench.run_id)
        rotate_key(store, reason="yearly", actor="ada")
        made = export_bundle(store, bench.run_id, folder / "bundle.zip", actor="ada")
    with zipfile.ZipFile(made.path) as archive:
        archive.extractall(folder / "unpacked")
    token, certificates = _stamp(folder, signed)
    return _Recorded(folder / "data", bench.run_id, made.path, folder / "unpacked", certificates, token, signed)


def _stamp(folder: Path, signed: Checkpoint) -> tuple[bytes, Path]:
    query = TimestampRequestBuilder().data(stamped_bytes(signed)).hash_algorithm(HashAlgorithm.SHA256).build()
    with time_stamp_authority(folder / "authority") as authority:
        request = urllib.request.Request(authority.url, data=query.as_bytes(), method="POST")
        with urllib.request.urlopen(request, timeout=30) as reply:
            return reply.read(), authority.certificates


# --- bundles ------------------------------------------------------------------------------------------------------


def _check(bundle: Path, certificates: Path | None = None) -> None:
    """Verify a bundle as the stand-alone verifier does, apart from what it prints."""
    check = bundle_verifier.Check()
    check.run(bundle, None, certificates)
    bundle_verifier.report(check).encode()
    json.dumps(check.faults)


def _small_zip(folder: Path) -> bytes:
    """The bundle's records without its files, stored and compressed: a small zip in which every byte counts."""
    with zipfile.ZipFile(folder / "small.zip", "w") as archive:
        for name in MEMBERS:
            kind = zipfile.ZIP_STORED if name.endswith(".sig") else zipfile.ZIP_DEFLATED
            archive.write(_recorded().unpacked / name, name, compress_type=kind)
    return (folder / "small.zip").read_bytes()


def _unpacked(folder: Path) -> Path:
    """A bundle of its own with the members; copied, because the folder may be on another file system."""
    bundle = folder / "bundle"
    bundle.mkdir()
    for member in MEMBERS:
        shutil.copyfile(_recorded().unpacked / member, bundle / member)
    return bundle


def _zips(folder: Path) -> list[bytes]:
    return [_small_zip(folder)]


def _zip(data: bytes, folder: Path) -> None:
    (folder / "bundle.zip").write_bytes(data)
    _check(folder / "bundle.zip")


def _members(_: Path) -> list[bytes]:
    """Seeds: a member's name and its content."""
    return [name.encode() + b"\n" + (_recorded().unpacked / name).read_bytes() for name in MEMBERS]


def _member(data: bytes, folder: Path) -> None:
    name, _, content = data.partition(b"\n")
    known = name.decode(errors="replace")
    bundle = _unpacked(folder)
    target = bundle / (known if known in MEMBERS else "events.jsonl")
    target.unlink()
    target.write_bytes(content)
    _check(bundle)


def _tokens(_: Path) -> list[bytes]:
    return [_recorded().token]


def _token(data: bytes, folder: Path) -> None:
    """Read a time stamp as the service reads a stored one, and as the verifier does."""
    known = _recorded()
    stamp = Timestamp(
        known.run_id, known.stamped.seq, "http://here", "2026-11-22T10:00:00Z", base64.b64encode(data).decode()
    )
    for certificates in (None, known.certificates):
        timestamp_findings([known.stamped], [stamp], certificates)
    bundle = _unpacked(folder)
    record = {"run_id": stamp.run_id, "seq": stamp.seq, "authority": "x", "token": stamp.token}
    line = bundle_verifier.canonical(record) + b"\n"
    manifest = json.loads((bundle / "manifest.json").read_bytes())
    manifest["files"].append({"path": "timestamps.jsonl", "sha256": "0" * 64, "size_bytes": len(line)})
    (bundle / "manifest.json").unlink()
    (bundle / "manifest.json").write_bytes(json.dumps(manifest).encode())
    (bundle / "timestamps.jsonl").write_bytes(line)
    _check(bundle, known.certificates)


def _certificate_files(_: Path) -> list[bytes]:
    return [_recorded().certificates.read_bytes()]


def _certificates(data: bytes, folder: Path) -> None:
    known = _recorded()
    path = folder / "authority.pem"
    path.write_bytes(data)
    stamp = Timestamp(known.run_id, known.stamped.seq, "http://here", "", base64.b64encode(known.token).decode())
    timestamp_findings([known.stamped], [stamp], path)
    with contextlib.suppress(bundle_verifier.NotABundleError):
        bundle_verifier.load_certificates(path)


# --- signatures and keys ------------------------------------------------------------------------------------------


def _logs(_: Path) -> list[bytes]:
    return [(_recorded().data / NAME).read_bytes()]


def _log(data: bytes, folder: Path) -> None:
    """Read a log as `audit verify` and the next signature do: every fault is reported and none is raised."""
    path = folder / NAME
    path.write_bytes(data)
    lines = read_log(path)
    known = _recorded()
    faults, notes = log_findings(lines, {known.run_id: [known.stamped]}, {}, awaited=True)
    if not faults and not notes:
        raise MisbehavedError("signatures of unknown keys are accepted")
    "\n".join([*(fault.what for fault in faults), *notes]).encode()
    with contextlib.suppress(FileNotFoundError):
        (folder / "copy").write_bytes(data[: len(data) // 2])
        LogCopy(folder / NAME, folder / "copy").bring_up_to_date()


def _keys(folder: Path) -> list[bytes]:
    KeyFolder(folder, DurableFiles()).make()
    return [path.read_bytes() for path in (folder / "keys").iterdir()]


def _key(data: bytes, folder: Path) -> None:
    key_id = key_fingerprint(public_bytes(Ed25519PrivateKey.from_private_bytes(bytes(32))))
    (folder / "keys").mkdir(mode=0o700)
    path = folder / "keys" / f"{key_id}.pem"
    path.touch(mode=0o600)
    path.write_bytes(data)
    KeyFolder(folder, DurableFiles()).load(key_id)


# --- events, database, snapshots ----------------------------------------------------------------------------------


def _events(_: Path) -> list[bytes]:
    lines = (_recorded().unpacked / "events.jsonl").read_bytes().splitlines()
    return [json.dumps(json.loads(line)["payload"]).encode() for line in lines]


def _event(data: bytes, _: Path) -> None:
    """Read the text of a row of the events table."""
    row: Any = SimpleNamespace(
        seq=1, run_id="run", at_utc="2026-11-22T10:00:00Z", monotonic_s=1.0, actor="ada",
        payload=data.decode(errors="replace"), previous_sha256="0" * 64, sha256="0" * 64,
    )  # fmt: skip
    to_event(row)


def _databases(_: Path) -> list[bytes]:
    return [(_recorded().data / "orthocapture.sqlite").read_bytes()]


def _database(data: bytes, folder: Path) -> None:
    known = _recorded()
    shutil.copytree(known.data, folder / "data", ignore=shutil.ignore_patterns("*.sqlite*"))
    (folder / "data" / "orthocapture.sqlite").write_bytes(data)
    report = verify(folder / "data", known.run_id)
    str(report.first_fault).encode()


def _snapshots(folder: Path) -> list[bytes]:
    write_snapshot(folder, "run", Snapshot())
    return [(folder / "monitor" / "run.json").read_bytes()]


def _snapshot(data: bytes, folder: Path) -> None:
    (folder / "monitor").mkdir()
    (folder / "monitor" / "run.json").write_bytes(data)
    snapshot = read_snapshot(folder, "run", 0.0)
    snapshot.model_dump_json()
    (folder / "monitor" / "run.verification.json").write_bytes(data)
    Verifications(folder, SystemClock()).last("run")


# --- web ----------------------------------------------------------------------------------------------------------

_RUN = "RUN"  # placeholder in URLs for the site's run
_REQUESTS: tuple[dict[str, Any], ...] = (
    {"path": "/sign-in", "role": "", "form": {"account": "grace", "password": "x", "next": "/"}},
    {"path": "/runs", "role": "supervisor", "form": {"protocol": "bench.yaml", "specimen": "S1"}},
    {"path": f"/runs/{_RUN}/ticks", "role": "technician",
     "form": {"step": "fixation", "attempt": "1", "item": "wires hold", "ticked": "true"}},
    {"path": f"/runs/{_RUN}/actions", "role": "supervisor",
     "form": {"verb": "redo", "step": "capture", "attempt": "1", "viewpoint": "v0", "reason": "blurred",
              "meaning": "", "password": "x", "account": "emmy", "signed_sha256": "0" * 64, "seen_seq": "3"}},
    {"path": f"/runs/{_RUN}/held", "role": "technician",
     "form": {"step": "capture", "attempt": "1", "what": "release"}},
    {"path": f"/runs/{_RUN}/control/take", "role": "supervisor", "form": {"reason": "she left"}},
    {"path": f"/runs/{_RUN}/control/answer", "role": "technician", "form": {"grant": "true"}},
    {"path": f"/audit/runs/{_RUN}/corrections", "role": "supervisor",
     "form": {"of_seq": "1", "field": "operator", "new": "Eva", "reason": "misspelt"}},
    {"path": f"/audit/runs/{_RUN}/corrections", "role": "supervisor",
     "form": {"of_seq": "9", "field": "monotonic_s", "new": "12.5", "reason": "misread"}},
    {"path": "/accounts", "role": "administrator",
     "form": {"account": "rosalind", "full_name": "Rosalind Franklin", "role": "technician"}},
    {"path": "/set-up/abcdef", "role": "", "form": {"account": "a", "password": "correct horse", "pin": "1234"}},
    {"path": f"/audit/runs/{_RUN}/timeline", "role": "auditor",
     "query": {"kind": "step_passed", "step": "capture", "page": "1"}},
    {"path": f"/audit/runs/{_RUN}/artefacts", "role": "auditor", "query": {"kind": "image", "page": "1"}},
    {"path": f"/audit/runs/{_RUN}/events/3", "role": "auditor", "query": {}},
    {"path": "/audit", "role": "auditor", "query": {"status": "completed", "page": "2", "q": "bench"}},
    {"path": f"/runs/{_RUN}/parts/side,step", "role": "technician", "query": {"seq": "3"}},
)  # fmt: skip


@dataclass
class _Site:
    """A site with people in every role, one waiting run and one finished run."""

    browsers: dict[str, Browser]
    run_id: str


_OPEN = contextlib.ExitStack()


@cache
def _site() -> _Site:
    """The site, opened once per process; it is closed while the process still has the thread that answers."""
    atexit.register(_OPEN.close)
    folder = Path(tempfile.mkdtemp(prefix="site-", dir=os.environ.get("TMPDIR")))
    site = _OPEN.enter_context(web_site(folder))
    site.record_run()
    bench = site.begin_run()
    browsers = {
        "": site.browser(),
        "technician": site.browser("technician"),
        "supervisor": site.browser("supervisor"),
        "auditor": site.browser("auditor"),
        "administrator": site.browser("administrator"),
    }
    site.take_control(bench.run_id, browsers["technician"])
    return _Site(browsers, bench.run_id)


def _requests(_: Path) -> list[bytes]:
    return [json.dumps(request).encode() for request in _REQUESTS]


def _web(data: bytes, _: Path) -> None:
    """Send a request given as JSON: path, role of the user, form or query, content type.

    Its CSRF token is always valid.
    """
    try:
        request = json.loads(data)
        path, role = str(request["path"]), str(request.get("role", ""))
        path.encode()
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return  # the input did not give a request
    site = _site()
    browser = site.browsers.get(role, site.browsers[""])
    address = "/" + path.replace(_RUN, site.run_id).lstrip("/")[:2000]
    form, query = request.get("form"), request.get("query")
    with contextlib.suppress(ValueError, TypeError, httpx.InvalidURL):  # requests that no client could send
        if isinstance(form, dict):
            csrf = browser.person.csrf if role in site.browsers and role else ""
            answer = browser.post(address, data={**form, "csrf": csrf}, follow_redirects=False)
        elif isinstance(query, dict):
            answer = browser.get(address, params=query, follow_redirects=False)
        else:
            content, kind = json.dumps(form).encode(), {"content-type": str(request.get("type", "application/json"))}
            answer = browser.post(address, content=content, headers=kind, follow_redirects=False)
        if answer.status_code >= 500:
            raise MisbehavedError(f"status {answer.status_code} for {address[:60]}")
        if "content-security-policy" not in answer.headers:
            raise MisbehavedError(f"an answer without its safety headers: {address[:60]}")


_CHECK = "service.audit.bundle_verifier:Check.run"
_VERIFIER: dict[str, Any] = {"errors": (bundle_verifier.NotABundleError,), "says_place": False}
_REFUSES_NOTHING: dict[str, Any] = {"errors": ()}

TARGETS: tuple[Target, ...] = (
    Target("bundle_zip", _CHECK, _zip, _zips, **_VERIFIER),
    Target(
        "bundle_member",
        _CHECK,
        _member,
        _members,
        JSON,
        pace=0.5,
        **_VERIFIER,
    ),
    Target(
        "time_stamp", "service.store.signatures.timestamps:timestamp_findings", _token, _tokens, pace=0.5, **_VERIFIER
    ),
    Target(
        "certificates",
        "service.store.signatures.timestamps:timestamp_findings",
        _certificates,
        _certificate_files,
        TEXT,
        pace=0.5,
    ),
    Target("signature_log", "service.store.signatures.log:log_findings", _log, _logs, JSON),
    Target("signing_key", "service.store.signatures.checkpoints:KeyFolder.load", _key, _keys, TEXT),
    Target("event", "service.store.events:to_event", _event, _events, JSON),
    Target(
        "database", "service.store.verification.verify:verify", _database, _databases, BYTES, seconds=10.0, pace=0.05
    ),
    Target("snapshot", "service.monitor.snapshot:read_snapshot", _snapshot, _snapshots, JSON, **_REFUSES_NOTHING),
    Target("web", "service.web.app:create_app", _web, _requests, JSON, pace=0.3, **_REFUSES_NOTHING),
)
