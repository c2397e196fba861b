"""The log of signatures: a second, append-only record of every checkpoint, in a file beside the database.

If the database is rewritten, cut or replaced, the log holds signatures that no longer fit it. Each line is signed and
holds the hash of the line before it, so that lines cannot be removed, changed or swapped. A cut at the end is found
with a copy kept elsewhere (service.store.signatures.log_copy).
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
PURPOSE = "orthocapture signature log v1"  # keeps a signature from being used for anything else
_FIRST = "0" * 64
_MOST_AT_ONCE = 3  # most signatures in one transaction: a new key's, a run's, and the site's chain's
_COLUMNS = {field.name: int if field.type == "int" else str for field in fields(Checkpoint)}


@dataclass(frozen=True, slots=True)
class LogLine:
    """One line of the log: a checkpoint, and a signature that binds it to the line before.

    Attributes:
        number: from 1.
        checkpoint: None if the line cannot be read.
        problem: why the line cannot be read or does not follow the line before it; "" if it is valid.
        message: the bytes that are signed.
        key_id: fingerprint of the key that signed the line.
        signature: base64.
    """

    number: int
    checkpoint: Checkpoint | None
    problem: str
    message: bytes = b""
    key_id: str = ""
    signature: str = ""

    def signed_by(self, public_key: bytes) -> bool:
        """Whether this key (32 raw bytes) made the line's signature."""
        try:
            signature = base64.b64decode(self.signature, validate=True)
            if base64.b64encode(signature).decode() != self.signature:  # the last character has unused bits
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

    def lines(self) -> list[LogLine] | None:
        """Every line, oldest first; None if there is no log. Raises StoreError if it cannot be read."""
        return read_log(self.path)

    def begin(self) -> None:
        """Create the log before the first signature; from then on a missing log is a fault. Raises StoreError."""
        try:
            if not self.path.exists():
                self._files.write(self.path, ())
            self._files.sync_directory(self.path.parent)
        except OSError as error:
            raise _unwritten(self.path, error) from error

    def add(self, checkpoints: Sequence[Checkpoint], key: Ed25519PrivateKey) -> None:
        """Append, durably, those checkpoints that the log does not hold yet. Raises StoreError."""
        try:
            _add(self._files, self.path, checkpoints, key)
        except OSError as error:
            raise _unwritten(self.path, error) from error


def unlogged(checkpoints: Sequence[Checkpoint], lines: Sequence[LogLine]) -> bool:
    """Whether a checkpoint has no line yet, because the log could not be written when it was made."""
    held = {(one.checkpoint.run_id, one.checkpoint.seq) for one in lines if one.checkpoint is not None}
    return any((one.run_id, one.seq) not in held for one in checkpoints)


def _unwritten(path: Path, error: OSError) -> StoreError:
    return StoreError(
        f"the log of signatures cannot be written: {error.strerror or error}",
        where=str(path),
        remedy="Check free space and permissions of the data folder",
    )


def read_log(path: Path) -> list[LogLine] | None:
    """The lines of a log; None if the file does not exist. Raises StoreError if it cannot be read."""
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


def _parsed(content: bytes) -> Iterator[LogLine]:
    previous = _FIRST
    # A line without a line end was cut off by a power failure and was never reported as written.
    whole = content[: content.rfind(b"\n") + 1]
    for number, raw in enumerate(whole.splitlines(keepends=True), start=1):
        yield _line(number, raw, previous)
        previous = hashlib.sha256(raw).hexdigest()


def _line(number: int, raw: bytes, previous: str) -> LogLine:
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
        return LogLine(number, None, "it cannot be read")
    problem = "" if (said_before, said_number) == (previous, number) else "it does not follow the line before it"
    if not problem and raw != written:
        problem = "it is not as it was written: its text was altered"
    return LogLine(number, checkpoint, problem, message, key_id, signature)


def _message(number: int, previous: str, checkpoint: Checkpoint, key_id: str) -> bytes:
    return canonical_parsed(_fields(number, previous, checkpoint, key_id) | {"purpose": PURPOSE}).encode()


def _fields(number: int, previous: str, checkpoint: Checkpoint, key_id: str) -> dict[str, Any]:
    return {"number": number, "previous_sha256": previous, "checkpoint": asdict(checkpoint), "key_id": key_id}


def _add(files: Files, path: Path, checkpoints: Sequence[Checkpoint], key: Ed25519PrivateKey) -> None:
    with path.open("rb") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)  # one process appends at a time
        content = stream.read()
        end = content.rfind(b"\n") + 1  # a power failure may have left part of a line after it
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
    lines: Sequence[LogLine] | None,
    present: Mapping[str, Sequence[Checkpoint]],
    public_keys: Mapping[str, bytes],
    *,
    awaited: bool,
) -> tuple[list[Fault], list[str]]:
    """Faults and notes on differences between the log and the checkpoints of a database.

    Args:
        lines: the log's lines, oldest first; None if there is no log.
        present: the database's checkpoints by run; lines for other runs are not compared.
        public_keys: raw public keys by fingerprint.
        awaited: whether there must be a log, because something was signed here.
    """
    if lines is None:
        missing = Fault(None, None, NAME, "the log of signatures is missing: it was removed")
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
            change = "is no longer here: what it signed was removed" if gone else "is another one here"
            faults.append(Fault(signed.run_id, signed.seq, "", f"the signature of {place}, {change}"))
    # A power failure between a signature and its line leaves out the newest lines; the next signature adds them.
    newest = max((line.checkpoint.site_seq for line in lines if line.checkpoint is not None), default=0)
    unlogged = {place: item for place, item in here.items() if place not in held}
    if len(unlogged) <= _MOST_AT_ONCE and all(item.site_seq >= newest for item in unlogged.values()):
        return faults, [f"{run_id}: the signature at event {seq} is not in {NAME} yet" for run_id, seq in unlogged]
    faults += [Fault(run_id, seq, "", f"its signature is not in {NAME}") for run_id, seq in unlogged]
    return faults, []
