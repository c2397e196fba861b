"""The forms of the anchors of the evidence in an object store: their names, contents and versions.

Each line of the log of signatures is one locked object, and once a day so are the ends of all chains with their
Merkle root (RFC 9162, 2.1). Nobody can take one back before a stated date, not even with the keys of the store.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any

from service.core.errors import StoreError
from service.store.events import canonical_parsed, parse_canonical

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
