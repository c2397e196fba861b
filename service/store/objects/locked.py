"""Locked objects: written once under COMPLIANCE retention in a bucket with versions, and read in every version."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterator
from datetime import UTC, datetime
from xml.etree import ElementTree

from service.store.objects.anchor_forms import ListedVersion, LockedVersion
from service.store.objects.interface import ObjectStoreAwayError, ObjectStoreError
from service.store.objects.s3 import S3Objects, require_success
from service.store.objects.signed_requests import SignedRequests

_MODE, _UNTIL = "x-amz-object-lock-mode", "x-amz-object-lock-retain-until-date"
_COMPLIANCE = "COMPLIANCE"
_NO_LOCK = "Make a bucket with object lock (it cannot be switched on later everywhere), or take lock_days out"


class LockedObjects:
    """The locked objects below the prefix of a site. Every method raises ObjectStoreError."""

    def __init__(self, objects: S3Objects) -> None:
        self._requests: SignedRequests = objects.requests
        self._prefix = objects.prefix
        self.place = objects.place

    def store(self, name: str, content: bytes, until: datetime) -> bool:
        """Store an object that nobody can delete before `until`, unless its name is taken. Says whether it was.

        What the store states of it afterwards is required to be what was asked for.
        """
        headers = {
            "if-none-match": "*",
            "x-amz-checksum-sha256": base64.b64encode(hashlib.sha256(content).digest()).decode(),
            _MODE: _COMPLIANCE,
            _UNTIL: f"{until:%Y-%m-%dT%H:%M:%SZ}",
        }
        answer = self._requests.send("PUT", self._key(name), headers=headers, body=content)
        if answer.status in {409, 412}:
            return False
        if answer.status == 400:
            raise ObjectStoreError(
                "the object store refused to lock an object: its bucket was made without object lock",
                where=self.place,
                remedy=_NO_LOCK,
            )
        require_success(answer, self.place)
        version = answer.headers.get("x-amz-version-id", "")
        stated = self._requests.send("HEAD", self._key(name), query={"versionId": version} if version else {})
        require_success(stated, self.place)
        held_until = _retention(stated.headers.get(_MODE, ""), stated.headers.get(_UNTIL, ""))
        if not version or held_until is None or held_until < until.replace(microsecond=0):
            raise ObjectStoreError(
                "the object store took an object and does not keep it locked as it was asked to",
                where=f"{name} in {self.place}",
                remedy=_NO_LOCK,
            )
        return True

    def versions(self, prefix: str) -> Iterator[ListedVersion]:
        """Yield every version of every object whose name begins so: by name, and of one name the newest first."""
        after: dict[str, str] = {}
        while True:
            query = {"versions": "", "prefix": self._key(prefix), **after}
            answer = self._requests.send("GET", query=query)
            require_success(answer, self.place)
            try:
                page = ElementTree.fromstring(answer.body)
                yield from self._listed(page)
            except (ElementTree.ParseError, ValueError) as error:
                raise ObjectStoreAwayError(
                    f"the object store's list of versions cannot be read: {error}", where=self.place
                ) from error
            if _text(page, "IsTruncated") != "true":
                return
            following = {
                "key-marker": _text(page, "NextKeyMarker"),
                "version-id-marker": _text(page, "NextVersionIdMarker"),
            }
            if following == after:
                raise ObjectStoreAwayError("the object store's list of versions does not end", where=self.place)
            after = following

    def _listed(self, page: ElementTree.Element) -> Iterator[ListedVersion]:
        for found in page:
            kind = found.tag.rpartition("}")[2]
            if kind in {"Version", "DeleteMarker"}:
                yield ListedVersion(
                    name=_text(found, "Key").removeprefix(self._key("")),
                    version=_text(found, "VersionId"),
                    at_utc=datetime.fromisoformat(_text(found, "LastModified")).astimezone(UTC),
                    size_bytes=int(_text(found, "Size") or 0),
                    deletion=kind == "DeleteMarker",
                )

    def read(self, listed: ListedVersion) -> LockedVersion | None:
        """Return the content of a version and its retention; None if it is gone meanwhile."""
        answer = self._requests.send("GET", self._key(listed.name), query={"versionId": listed.version})
        if answer.status == 404:
            return None
        require_success(answer, self.place)
        until = _retention(answer.headers.get(_MODE, ""), answer.headers.get(_UNTIL, ""))
        return LockedVersion(listed, answer.body, until)

    def _key(self, name: str) -> str:
        return f"{self._prefix}/{name}" if self._prefix else name


def _text(element: ElementTree.Element, name: str) -> str:
    """Return the text of a child, in whatever namespace the store writes it; "" if there is none."""
    return next((child.text or "" for child in element if child.tag.rpartition("}")[2] == name), "")


def _retention(mode: str, until: str) -> datetime | None:
    """Return the end of a COMPLIANCE retention; None for any other, which somebody with rights could end."""
    if mode != _COMPLIANCE:
        return None
    try:
        return datetime.fromisoformat(until).astimezone(UTC)
    except ValueError:
        return None
