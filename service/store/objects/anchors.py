"""Anchors of the evidence in an object store: their formats, the locked objects that hold them, their writing.

Each line of the log of signatures is one locked object, and once a day so are the ends of all chains with their
Merkle root (RFC 9162, 2.1). Nobody can take one back before a stated date, not even with the keys of the store.
"""

from __future__ import annotations

import base64
import hashlib
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from sqlalchemy import select

from service.core.errors import StoreError
from service.store.database.tables import heads
from service.store.durable_effects import utc_text
from service.store.events import canonical_parsed, parse_canonical
from service.store.objects.interface import ObjectStoreAwayError, ObjectStoreError
from service.store.objects.s3 import S3Objects, SignedRequests, require_success
from service.store.signatures.log import NAME as LOG_NAME
from service.store.signatures.signing import sign
from service.store.store import Store

FOLDER = "anchors/"
LINES, ROOTS = f"{FOLDER}lines/", f"{FOLDER}roots/"
PURPOSE = "orthocapture anchor v1"
_DIGITS = 12

Head = tuple[str, int, str]  # run, number of its last event, and the event's SHA-256


def line_name(number: int) -> str:
    """Return the name of the anchor of a line of the log of signatures."""
    return f"{LINES}{number:0{_DIGITS}d}"


def line_number(name: str) -> int | None:
    """Return the number of the line whose anchor has this name; None for any other name."""
    digits = name.removeprefix(LINES)
    return int(digits) if name.startswith(LINES) and len(digits) == _DIGITS and digits.isdecimal() else None


def merkle_root(ends: Sequence[Head]) -> str:
    """Return the Merkle root over the ends of all chains, in the order given: RFC 9162, 2.1.1, with SHA-256."""
    if not ends:
        return hashlib.sha256(b"").hexdigest()
    level = [hashlib.sha256(b"\0" + canonical_parsed(list(end)).encode()).digest() for end in ends]
    while len(level) > 1:
        pairs = zip(level[::2], level[1::2], strict=False)
        above = [hashlib.sha256(b"\1" + left + right).digest() for left, right in pairs]
        level = [*above, level[-1]] if len(level) % 2 else above
    return level[0].hex()


@dataclass(frozen=True, slots=True)
class LineAnchor:
    """The anchor of one line of the log of signatures.

    Attributes:
        line: the line, without its end.
        retained_until_utc: the end of its lock, as it was asked for.
    """

    line: str
    retained_until_utc: str

    def content(self) -> bytes:
        """Return the content of the object."""
        return canonical_parsed(asdict(self) | {"purpose": PURPOSE}).encode()

    @classmethod
    def parse(cls, content: bytes) -> LineAnchor | None:
        """Return the anchor with this content; None for any other content."""
        match _fields(content):
            case {"line": str(line), "retained_until_utc": str(until_utc)}:
                made = cls(line, until_utc)
                return made if _writes(made, content) else None
            case _:
                return None


@dataclass(frozen=True, slots=True)
class RootAnchor:
    """The anchor of a day: the ends of all chains.

    Attributes:
        day: the day (UTC).
        at_utc: when the ends were read.
        retained_until_utc: the end of its lock, as it was asked for.
        root: the Merkle root over the ends.
        heads: the ends, sorted.
        key_id: fingerprint of the key that signed it.
        signature: the signature in base64.
    """

    day: str
    at_utc: str
    retained_until_utc: str
    root: str
    heads: tuple[Head, ...]
    key_id: str = ""
    signature: str = ""

    def message(self) -> bytes:
        """Return the bytes that are signed: all of it but key and signature, after its purpose."""
        named = {name: value for name, value in asdict(self).items() if name not in {"key_id", "signature"}}
        return f"{PURPOSE}\n{canonical_parsed(named)}".encode()

    def content(self) -> bytes:
        """Return the content of the object."""
        return canonical_parsed(asdict(self) | {"purpose": PURPOSE}).encode()

    @classmethod
    def parse(cls, content: bytes) -> RootAnchor | None:
        """Return the anchor with this content; None for any other content."""
        fields = _fields(content)
        try:
            ends = tuple(_head(end) for end in fields.pop("heads"))
            texts = {name: str(value) for name, value in fields.items() if name != "purpose"}
            made = cls(heads=ends, **texts)
        except (KeyError, TypeError, ValueError):
            return None
        return made if _writes(made, content) else None


def _writes(anchor: LineAnchor | RootAnchor, content: bytes) -> bool:
    """Return whether an anchor is written as this content, which anybody may have put there."""
    try:
        return anchor.content() == content
    except (StoreError, ValueError):  # text that no JSON can hold
        return False


def _head(end: Any) -> Head:
    run_id, seq, sha256 = end
    return str(run_id), int(seq), str(sha256)


def _fields(content: bytes) -> dict[str, Any]:
    """Return the fields of JSON content; none for anything else."""
    try:
        found: Any = parse_canonical(content.decode())
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


@dataclass(frozen=True, slots=True)
class ListedVersion:
    """One version of an object as the store lists it.

    Attributes:
        name: the object's name below the prefix of the site.
        version: the store's name of the version.
        at_utc: when the store took it.
        size_bytes: its size.
        deletion: true if it is no content but a mark that the object was deleted.
    """

    name: str
    version: str
    at_utc: datetime
    size_bytes: int
    deletion: bool


@dataclass(frozen=True, slots=True)
class LockedVersion:
    """The content of one version, and until when the store says that nobody can delete it.

    Attributes:
        listed: the version as it was listed.
        content: its bytes.
        retained_until: the end of its COMPLIANCE retention; None if it has none.
    """

    listed: ListedVersion
    content: bytes
    retained_until: datetime | None


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


# Writes the anchors of the evidence into the object store, as the uploader comes to it.
#
# It is beside every capture and signature, and never in their way.


_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Place:
    """How far the log of signatures was read: bytes, and whole lines."""

    offset: int = 0
    lines: int = 0


class AnchorWriter:
    """Writes the anchors of one data folder. It belongs to the uploader: no capture and no signature waits for it."""

    def __init__(self, store: Store, objects: LockedObjects, lock_days: int) -> None:
        self._store = store
        self._objects = objects
        self._locked_for = timedelta(days=lock_days)
        self._log: Path = store.database_path.parent / LOG_NAME
        self._held: set[int] | None = None  # lines that have an anchor, whatever it holds
        self._place = _Place()
        self._root_day = ""
        self.beyond = 0  # lines that have an anchor and are not in the log

    def write(self, stopped: Callable[[], bool] = lambda: False) -> int:
        """Anchor what has no anchor yet. Returns how many were written. Raises ObjectStoreError, StoreError.

        What has an anchor already is left as it is, whatever it holds: `audit verify` compares.
        """
        new = self._new_lines()
        if not new and not self._place.lines:
            return 0  # nothing was signed yet
        if self._held is None:
            numbers = (line_number(listed.name) for listed in self._objects.versions(LINES))
            self._held = {number for number in numbers if number is not None}
        written = 0
        for line in new:
            if stopped():
                return written
            number = self._place.lines + 1
            if number not in self._held:
                until = self._until()
                anchor = LineAnchor(line.decode(errors="replace").rstrip("\n"), utc_text(until))
                written += self._objects.store(line_name(number), anchor.content(), until)
                self._held.add(number)
            self._place = _Place(self._place.offset + len(line), number)
        self.beyond = sum(number > self._place.lines for number in self._held)
        return written + self._write_root()

    def _until(self) -> datetime:
        return (self._store.clock.utc_now() + self._locked_for).replace(microsecond=0)

    def _new_lines(self) -> list[bytes]:
        """Return the whole lines of the log after the last one that was anchored; all again if the log was cut."""
        try:
            with self._log.open("rb") as stream:
                if stream.seek(0, 2) < self._place.offset:
                    _log.error("the log of signatures is shorter than it was: run `orthocapture audit verify all`")
                    self._place = _Place()
                stream.seek(self._place.offset)
                found = stream.read()
        except FileNotFoundError:
            return []
        except OSError as error:
            raise StoreError(
                f"the log of signatures cannot be read: {error.strerror or error}",
                where=str(self._log),
                remedy="Check the permissions of the data folder",
            ) from error
        return found[: found.rfind(b"\n") + 1].splitlines(keepends=True)

    def _write_root(self) -> int:
        """Anchor the ends of all chains, the first time on each day (UTC)."""
        now = self._store.clock.utc_now().astimezone(UTC)
        day = now.date().isoformat()
        if self._root_day == day:
            return 0
        written = 0
        if not any(True for _ in self._objects.versions(f"{ROOTS}{day}")):
            until = self._until()
            content = self.root(day, utc_text(now), utc_text(until)).content()
            written = int(self._objects.store(f"{ROOTS}{day}", content, until))
        self._root_day = day
        return written

    def root(self, day: str, at_utc: str, until_utc: str) -> RootAnchor:
        """Return the anchor of a day: the ends of all chains now, and their root, signed."""
        with self._store.database.reading() as connection:
            rows = connection.execute(select(heads.c.run_id, heads.c.seq, heads.c.sha256)).all()
        ends: tuple[Head, ...] = tuple(sorted((str(row.run_id), int(row.seq), str(row.sha256)) for row in rows))
        unsigned = RootAnchor(day, at_utc, until_utc, merkle_root(ends), ends)
        key_id, signature = sign(self._store, unsigned.message())
        return replace(unsigned, key_id=key_id, signature=signature)
