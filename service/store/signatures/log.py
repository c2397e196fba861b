"""Everything that was ever signed, once more, in a file beside the database to which lines are only added.

Who rewrites, cuts back or replaces the database leaves signatures behind that no longer fit it. Each line is signed
itself and names the line before it, so that lines cannot be taken out, changed or exchanged; that the end was not cut
off shows in a copy elsewhere (service.store.signatures.log_copy).
"""

from __future__ import annotations

import base64
import binascii
import fcntl
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from service.core.errors import StoreError
from service.store.durable_effects import Files
from service.store.events import canonical_parsed
from service.store.records import Checkpoint
from service.store.signatures.checkpoints import key_fingerprint
from service.store.signatures.keys import public_bytes
from service.store.verification.chain_checks import Fault

NAME = "signatures.jsonl"
PURPOSE = "orthocapture signature log v1"  # so that no signature of this key can be taken for one of another kind
_FIRST = "0" * 64
_MOST_AT_ONCE = 3  # signatures of one transaction: of a new key, of a run, of the site's chain that names it
_COLUMNS = {field.name: int if field.type == "int" else str for field in fields(Checkpoint)}


@dataclass(frozen=True, slots=True)
class Line:
    """One line: a checkpoint, and the signature that binds it to the line before.

    Attributes:
        number: from 1.
        checkpoint: None for a line that cannot be read.
        problem: why it cannot be read, or does not follow the line before it; "" for a sound one.
        message: what is signed.
        key_id: of the key that signed the line.
        signature: base64.
    """

    number: int
    checkpoint: Checkpoint | None
    problem: str
    message: bytes = b""
    key_id: str = ""
    signature: str = ""

    def signed_by(self, public_key: bytes) -> bool:
        """Whether the line's signature is this key's."""
        try:
            signature = base64.b64decode(self.signature, validate=True)
            if base64.b64encode(signature).decode() != self.signature:  # its last letter has bits that say nothing
                return False
            Ed25519PublicKey.from_public_bytes(public_key).verify(signature, self.message)
        except (InvalidSignature, binascii.Error, ValueError):
            return False
        return True


class SignatureLog:
    """The log of one data folder."""

    def __init__(self, data_dir: Path, files: Files) -> None:
        self.path = data_dir / NAME
        self._files = files

    def lines(self) -> list[Line] | None:
        """Every line, oldest first; None where there is no log. Raises StoreError."""
        return read_log(self.path)

    def begin(self) -> None:
        """Make the log before the first signature: from then on it is missed. Raises StoreError."""
        try:
            if not self.path.exists():
                self._files.write(self.path, ())
            self._files.sync_directory(self.path.parent)
        except OSError as error:
            raise _unwritten(self.path, error) from error

    def add(self, checkpoints: Sequence[Checkpoint], key: Ed25519PrivateKey) -> None:
        """Append those that the log does not hold yet, durably. Raises StoreError."""
        try:
            _add(self._files, self.path, checkpoints, key)
        except OSError as error:
            raise _unwritten(self.path, error) from error


def unlogged(checkpoints: Sequence[Checkpoint], lines: Sequence[Line]) -> bool:
    """Whether a signature has no line yet: the log could not be written when it was made."""
    held = {(one.checkpoint.run_id, one.checkpoint.seq) for one in lines if one.checkpoint is not None}
    return any((one.run_id, one.seq) not in held for one in checkpoints)


def _unwritten(path: Path, error: OSError) -> StoreError:
    return StoreError(
        f"what is signed cannot be written down: {error.strerror or error}",
        where=str(path),
        remedy="Check free space and permissions of the data folder",
    )


def read_log(path: Path) -> list[Line] | None:
    """The lines of a log; None where there is no such file. Raises StoreError when it cannot be read."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise StoreError(
            f"the log of signatures cannot be read: {error.strerror}",
            where=str(path),
            remedy="Check the permissions of the data folder",
        ) from error
    return list(_parsed(content))


def _parsed(content: bytes) -> Iterator[Line]:
    previous = _FIRST
    # A line without its end is what a power cut left of one that was never reported as written.
    whole = content[: content.rfind(b"\n") + 1]
    for number, raw in enumerate(whole.splitlines(keepends=True), start=1):
        yield _line(number, raw, previous)
        previous = hashlib.sha256(raw).hexdigest()


def _line(number: int, raw: bytes, previous: str) -> Line:
    try:
        data = json.loads(raw)
        values = {name: data["checkpoint"][name] for name in _COLUMNS}
        if any(type(values[name]) is not kind for name, kind in _COLUMNS.items()):
            raise TypeError("a field is of another kind")  # noqa: TRY301
        checkpoint = Checkpoint(**values)
        key_id, signature = str(data["key_id"]), str(data["signature"])
        said_before, said_number = data["previous_sha256"], data["number"]
        message = _message(number, previous, checkpoint, key_id)
        written = canonical_parsed(data).encode() + b"\n"
    except (ValueError, TypeError, KeyError, RecursionError, StoreError):
        return Line(number, None, "it cannot be read")
    problem = "" if (said_before, said_number) == (previous, number) else "it does not follow the line before it"
    if not problem and raw != written:
        problem = "it is not as it was written: its text was altered"
    return Line(number, checkpoint, problem, message, key_id, signature)


def _message(number: int, previous: str, checkpoint: Checkpoint, key_id: str) -> bytes:
    return canonical_parsed(_fields(number, previous, checkpoint, key_id) | {"purpose": PURPOSE}).encode()


def _fields(number: int, previous: str, checkpoint: Checkpoint, key_id: str) -> dict[str, Any]:
    return {"number": number, "previous_sha256": previous, "checkpoint": asdict(checkpoint), "key_id": key_id}


def _add(files: Files, path: Path, checkpoints: Sequence[Checkpoint], key: Ed25519PrivateKey) -> None:
    with path.open("rb") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)  # one process appends at a time
        content = stream.read()
        end = content.rfind(b"\n") + 1  # behind it: half a line, of a write that a power cut ended
        lines = list(_parsed(content[:end]))
        held = {(line.checkpoint.run_id, line.checkpoint.seq) for line in lines if line.checkpoint is not None}
        last = content[:end].splitlines(keepends=True)[-1:]
        number, previous = len(lines), hashlib.sha256(last[0]).hexdigest() if last else _FIRST
        key_id = key_fingerprint(public_bytes(key))
        new = b""
        for checkpoint in checkpoints:
            if (checkpoint.run_id, checkpoint.seq) in held:
                continue
            number += 1
            signature = base64.b64encode(key.sign(_message(number, previous, checkpoint, key_id))).decode()
            data = _fields(number, previous, checkpoint, key_id) | {"signature": signature}
            raw = canonical_parsed(data).encode() + b"\n"
            new += raw
            previous = hashlib.sha256(raw).hexdigest()
        files.append(path, end, new)
        files.sync_file(path)


def log_findings(
    lines: Sequence[Line] | None,
    present: Mapping[str, Sequence[Checkpoint]],
    public_keys: Mapping[str, bytes],
    *,
    awaited: bool,
) -> tuple[list[Fault], list[str]]:
    """Faults and notes: what does not fit between a log and the checkpoints of a database.

    Args:
        lines: of the log, oldest first; None where there is none.
        present: the database's checkpoints, by run; runs that are not among them are left out.
        public_keys: raw, by fingerprint.
        awaited: whether there must be a log: this software, or a later one, has signed here.
    """
    if lines is None:
        missing = Fault(None, None, NAME, "the log of signatures is missing: it was taken away")
        return ([missing] if awaited else []), []
    faults: list[Fault] = []
    held: set[tuple[str, int]] = set()
    here = {(run_id, item.seq): item for run_id, items in present.items() for item in items}
    for line in lines:
        place, signed = f"{NAME}, line {line.number}", line.checkpoint
        if signed is None or line.problem:
            faults.append(Fault(None, None, place, line.problem))
            continue
        key = public_keys.get(line.key_id)
        if key is None or not line.signed_by(key):
            faults.append(Fault(None, None, place, "its own signature is not valid"))
        held.add((signed.run_id, signed.seq))
        if signed.run_id in present and here.get((signed.run_id, signed.seq)) != signed:
            gone = (signed.run_id, signed.seq) not in here
            change = "is no longer here: what it signed was taken away" if gone else "is another one here"
            faults.append(Fault(signed.run_id, signed.seq, "", f"the signature of {place}, {change}"))
    # A power cut between a signature and its line leaves the newest ones out, which the next signature makes good.
    newest = max((line.checkpoint.site_seq for line in lines if line.checkpoint is not None), default=0)
    unlogged = {place: item for place, item in here.items() if place not in held}
    if len(unlogged) <= _MOST_AT_ONCE and all(item.site_seq >= newest for item in unlogged.values()):
        return faults, [f"{run_id}: the signature at event {seq} is not in {NAME} yet" for run_id, seq in unlogged]
    faults += [Fault(run_id, seq, "", f"its signature is not in {NAME}") for run_id, seq in unlogged]
    return faults, []
