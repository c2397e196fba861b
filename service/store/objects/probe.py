"""Probes an object store: what it says of itself is tried with an object of no value, a canary."""

from __future__ import annotations

import base64
import hashlib
import secrets
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

from service.core.errors import StoreError
from service.store.durable_effects import Clock
from service.store.objects.s3 import S3Objects, require_success

_LOCKED_FOR = timedelta(minutes=2)  # of the canary; the lock of evidence lasts for days


@dataclass(frozen=True, slots=True)
class ProbeResult:
    """One thing that was tried. `problem` is "" if the store did as it must."""

    name: str
    problem: str


class _UnfitError(Exception):
    """The store did not do as it must."""


def probe(objects: S3Objects, clock: Clock, *, lock_days: int | None = None) -> list[ProbeResult]:
    """Try what the evidence relies on; the first failure ends it, for the rest needs what failed."""
    content = f"canary of orthocapture {secrets.token_hex(16)}".encode()
    sha256 = hashlib.sha256(content).hexdigest()
    tried: list[tuple[str, Callable[[], None]]] = [
        ("the bucket exists", objects.require_bucket),
        ("a new object is stored", lambda: _store_canary(objects, sha256, content)),
        ("a second put of other bytes loses", lambda: _put_again(objects, sha256)),
        ("bytes that do not have the stated SHA-256 are refused", lambda: _put_wrong(objects)),
        ("what is fetched is what was put", lambda: _fetch(objects, sha256)),
        ("the store states the object's SHA-256", lambda: _stat(objects, sha256, len(content))),
        ("a deleted object is gone", lambda: _delete(objects, sha256)),
    ]
    if lock_days is not None:
        tried.append(("a locked object cannot be deleted", lambda: _lock(objects, clock)))
    results: list[ProbeResult] = []
    for name, attempt in tried:
        try:
            attempt()
        except _UnfitError as unfit:
            results.append(ProbeResult(name, str(unfit)))
        except StoreError as error:
            results.append(ProbeResult(name, error.what))
        else:
            results.append(ProbeResult(name, ""))
        if results[-1].problem:
            break
    return results


def _store_canary(objects: S3Objects, sha256: str, content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "canary")
        path.write_bytes(content)
        if not objects.put_if_absent(sha256, path):
            raise _UnfitError("the store says that an object of a new name exists")


def _put_again(objects: S3Objects, sha256: str) -> None:
    other = b"other bytes"
    answer = objects.requests.send(
        "PUT", objects.key(sha256), headers={"if-none-match": "*"} | _checksum(other), body=other
    )
    if answer.status not in {409, 412}:
        raise _UnfitError(f"an existing object was overwritten, or the put was not refused: status {answer.status}")


def _put_wrong(objects: S3Objects) -> None:
    name = hashlib.sha256(secrets.token_bytes(16)).hexdigest()
    answer = objects.requests.send("PUT", objects.key(name), headers=_checksum(b"these bytes"), body=b"those bytes")
    if answer.status < 300:
        objects.delete(name)
        raise _UnfitError("the store took bytes whose SHA-256 was stated wrongly")


def _fetch(objects: S3Objects, sha256: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        objects.fetch(sha256, Path(folder, "canary"))


def _stat(objects: S3Objects, sha256: str, size_bytes: int) -> None:
    found = objects.stat(sha256)
    if found is None:
        raise _UnfitError("the store does not know the object that it took")
    if (found.sha256, found.size_bytes) != (sha256, size_bytes):
        raise _UnfitError(f"it states SHA-256 {found.sha256 or 'none'} and {found.size_bytes} bytes")


def _delete(objects: S3Objects, sha256: str) -> None:
    objects.delete(sha256)
    if objects.stat(sha256) is not None:
        raise _UnfitError("the object is still there")


def _lock(objects: S3Objects, clock: Clock) -> None:
    content = secrets.token_bytes(16)
    key = objects.key(hashlib.sha256(content).hexdigest())
    until = clock.utc_now() + _LOCKED_FOR
    locked = {
        "x-amz-object-lock-mode": "COMPLIANCE",
        "x-amz-object-lock-retain-until-date": f"{until:%Y-%m-%dT%H:%M:%SZ}",
    }
    answer = objects.requests.send("PUT", key, headers=locked | _checksum(content), body=content)
    require_success(answer, objects.place)
    version = answer.headers.get("x-amz-version-id", "")
    if not version:
        raise _UnfitError("the bucket has no versions: make it with object lock")
    ways = {"": {}, "by its owner's leave": {"x-amz-bypass-governance-retention": "true"}}
    for way, headers in ways.items():
        deleted = objects.requests.send("DELETE", key, query={"versionId": version}, headers=headers)
        if deleted.status < 300:
            raise _UnfitError(f"a locked version was deleted {way}".strip())


def _checksum(content: bytes) -> dict[str, str]:
    return {"x-amz-checksum-sha256": base64.b64encode(hashlib.sha256(content).digest()).decode()}
