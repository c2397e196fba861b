"""Opens the object store that a site's file names, with its keys, and tries what it says of itself."""

from __future__ import annotations

import base64
import hashlib
import os
import secrets
import stat
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import yaml

from service.core.errors import ConfigurationError, StoreError
from service.store.data_folder import SITE_FILE
from service.store.durable_effects import Clock, SystemClock
from service.store.objects.s3 import S3Objects, StoreKeys, require_success
from service.store.site import ObjectStoreSection

_VARIABLES = ("ORTHOCAPTURE_S3_ACCESS_KEY_ID", "ORTHOCAPTURE_S3_SECRET_ACCESS_KEY")


def open_objects(data_dir: Path, section: ObjectStoreSection, clock: Clock | None = None) -> S3Objects:
    """Return the object store that a site's file names. Nothing is sent. Raises ConfigurationError."""
    return S3Objects(
        endpoint=section.endpoint,
        bucket=section.bucket,
        prefix=section.prefix,
        region=section.region,
        keys=_keys(data_dir, section),
        clock=clock or SystemClock(),
    )


def _keys(data_dir: Path, section: ObjectStoreSection) -> StoreKeys:
    if section.keys == "environment":
        values = [os.environ.get(name, "") for name in _VARIABLES]
        missing = [name for name, value in zip(_VARIABLES, values, strict=True) if not value]
        if missing:
            raise ConfigurationError(
                f"the keys of the object store are not in the environment: {', '.join(missing)}",
                where=str(data_dir / SITE_FILE),
                remedy="Set them, or name a file with `keys:`",
            )
        return StoreKeys(*values)
    path = data_dir / section.keys
    remedy = "Write access_key_id and secret_access_key into it as YAML, and `chmod 600` it"
    try:
        mode = path.stat().st_mode
        if stat.S_IMODE(mode) & 0o077:
            raise ConfigurationError(
                "others than its owner may read the keys of the object store", where=str(path), remedy=remedy
            )
        found: Any = yaml.safe_load(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:  # a parser's message could quote a key
        said = error.strerror if isinstance(error, OSError) else "it is not YAML"
        raise ConfigurationError(
            f"the keys of the object store cannot be read: {said}", where=str(path), remedy=remedy
        ) from None
    names = ("access_key_id", "secret_access_key")
    values = [found.get(name) for name in names] if isinstance(found, dict) else []
    if len(values) != 2 or not all(isinstance(value, str) and value for value in values):
        raise ConfigurationError("the keys of the object store are incomplete", where=str(path), remedy=remedy)
    return StoreKeys(*map(str, values))


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
