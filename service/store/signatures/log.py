"""The log of signatures: a second, append-only record of every checkpoint, in a file beside the database.

If the database is rewritten, cut or replaced, the log holds signatures that no longer fit it. Each line is signed and
holds the hash of the line before it, so that lines cannot be removed, changed or swapped. A cut at the end is found
with a copy elsewhere (service.store.signatures.second_place).
"""

from __future__ import annotations

import base64
import binascii
import fcntl
import hashlib
import json
import os
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from threading import Lock
from typing import Any

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from sqlalchemy import Connection, literal_column, select

from service.core.errors import StoreError
from service.core.records.events import SignaturesWrittenAgain
from service.store.database.engine import LOOK
from service.store.database.tables import checkpoints, events
from service.store.durable_effects import Files
from service.store.events import canonical_parsed, parse_canonical
from service.store.records import SITE, Checkpoint
from service.store.signatures.checkpoints import key_fingerprint, public_bytes, read_checkpoint, to_checkpoint
from service.store.verification.chain_checks import Fault

NAME = "signatures.jsonl"
PURPOSE = "orthocapture signature log v1"  # keeps a signature from being used for anything else
_FIRST = "0" * 64
_LOOK_AGAIN_S = 0.005
_MOST_AT_ONCE = 3  # most signatures in one transaction: a new key's, a run's, and the site's chain's
_COLUMNS = {field.name: int if field.type == "int" else str for field in fields(Checkpoint)}


@dataclass(frozen=True, slots=True)
class LogLine:
    """One line of the log: a checkpoint, and a signature that binds it to the line before.

    Attributes:
        number: the line's number, from 1.
        checkpoint: the checkpoint in the line; None if the line cannot be read.
        problem: the reason why the line cannot be read or does not follow the one before it; "" if it is valid.
        message: the bytes that are signed.
        key_id: fingerprint of the key that signed the line.
        signature: the signature in base64.
        raw: the line as it is in the file, without its end.
    """

    number: int
    checkpoint: Checkpoint | None
    problem: str
    message: bytes = b""
    key_id: str = ""
    signature: str = ""
    raw: bytes = b""

    def signed_by(self, public_key: bytes) -> bool:
        """Return whether this key (32 raw bytes) made the line's signature."""
        try:
            signature = base64.b64decode(self.signature, validate=True)
            if base64.b64encode(signature).decode() != self.signature:  # the last character has unused bits
                return False
            Ed25519PublicKey.from_public_bytes(public_key).verify(signature, self.message)
        except (InvalidSignature, binascii.Error, ValueError):
            return False
        return True


@dataclass(frozen=True, slots=True)
class LogEnd:
    """A place in the log where a line ends: the beginning of the log, or how far it was read."""

    offset: int = 0  # bytes before it
    number: int = 0  # number of the last line before it
    last_bytes: int = 0  # length of that line
    previous: str = _FIRST  # SHA-256 of that line


class SignatureLog:
    """The log of one data folder. `patience_s` is how long it waits for another process that signs."""

    def __init__(self, data_dir: Path, files: Files, patience_s: float) -> None:
        self.path = data_dir / NAME
        self._files = files
        self._patience_s = patience_s

    @contextmanager
    def alone(self) -> Generator[None]:
        """Wait until no other process or thread signs, and keep them waiting. Raises StoreError.

        A signature is a row and then a line: whoever signs next finds both.
        """
        try:
            descriptor = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except OSError as error:
            raise _unwritten(self.path, error) from error
        try:
            self._wait_for(descriptor)
            yield
        finally:
            os.close(descriptor)

    def _wait_for(self, descriptor: int) -> None:
        ends_s = time.monotonic() + self._patience_s
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                if time.monotonic() > ends_s:
                    raise StoreError(
                        "another process has been signing for too long",
                        where=str(self.path),
                        remedy="Look for a process of this data folder that hangs",
                    ) from error
                time.sleep(_LOOK_AGAIN_S)
            else:
                return

    def begin(self) -> None:
        """Create the log before the first signature; from then on a missing log is a fault. Raises StoreError."""
        try:
            if not self.path.exists():
                self._files.write(self.path, ())
            self._files.sync_directory(self.path.parent)
        except OSError as error:
            raise _unwritten(self.path, error) from error

    def lines_after(self, end: LogEnd) -> tuple[list[LogLine], LogEnd] | None:
        """Return the lines after a place, and where the last of them ends.

        None if there is no log, or the line before that place is no longer there. Raises StoreError if it cannot be
        read.
        """
        content = _content(self.path, end.offset - end.last_bytes)
        if content is None or (end.number and _sha256(content[: end.last_bytes]) != end.previous):
            return None
        lines: list[LogLine] = []
        for line, after in _parsed(content[end.last_bytes :], end):
            lines.append(line)
            end = after
        return lines, end

    def add(self, end: LogEnd, checkpoints: Sequence[Checkpoint], key: Ed25519PrivateKey) -> None:
        """Append checkpoints durably where the last whole line ends. Raises StoreError.

        What follows is part of a line that a power failure interrupted. Callers are `alone`.
        """
        number, previous, key_id = end.number, end.previous, key_fingerprint(public_bytes(key))
        new = b""
        for checkpoint in checkpoints:
            number += 1
            signature = base64.b64encode(key.sign(_message(number, previous, checkpoint, key_id))).decode()
            data = _fields(number, previous, checkpoint, key_id) | {"signature": signature}
            raw = canonical_parsed(data).encode() + b"\n"
            new += raw
            previous = _sha256(raw)
        try:
            self._files.append(self.path, end.offset, new)
            self._files.sync_file(self.path)
        except OSError as error:
            raise _unwritten(self.path, error) from error


def power_cut_explains(missing: Sequence[Checkpoint], newest: int) -> bool:
    """Return whether one interrupted signature explains that these checkpoints have no line.

    The next signature writes the lines that are missing before anything else, so that no more than those of one
    signature can be. `newest` is the greatest `site_seq` that has a line.
    """
    return len(missing) <= _MOST_AT_ONCE and all(item.site_seq >= newest for item in missing)


@contextmanager
def copying_alone(log: Path) -> Generator[None]:
    """Wait until no other process writes to the second place of this log, and keep them waiting.

    Signatures do not wait for it: a lock of the folder serialises them (SignatureLog.alone). Before the first
    signature there is nothing to wait for. Raises StoreError if the log cannot be read.
    """
    try:
        descriptor = os.open(log, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        yield
        return
    except OSError as error:
        raise unreadable(log, error) from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def unreadable(path: Path, error: OSError) -> StoreError:
    """Return the error of a log of signatures, or of a copy of it, that cannot be read."""
    return StoreError(f"the log of signatures cannot be read: {error.strerror}", where=str(path), remedy=LOOK)


def _unwritten(path: Path, error: OSError) -> StoreError:
    return StoreError(
        f"the log of signatures cannot be written: {error.strerror or error}",
        where=str(path),
        remedy="Check free space and permissions of the data folder",
    )


def read_log(path: Path) -> list[LogLine] | None:
    """Return the lines of a log; None if the file does not exist. Raises StoreError if it cannot be read."""
    content = _content(path, 0)
    return None if content is None else [line for line, _ in _parsed(content, LogEnd())]


def _content(path: Path, offset: int) -> bytes | None:
    """Return the log from an offset on; None if the file does not exist. Raises StoreError."""
    try:
        with path.open("rb") as stream:
            stream.seek(offset)
            return stream.read()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise unreadable(path, error) from error


def _parsed(content: bytes, end: LogEnd) -> Iterator[tuple[LogLine, LogEnd]]:
    """Yield the lines that follow a place, each with its own end."""
    # A line without a line end was cut off by a power failure and was never reported as written.
    whole = content[: content.rfind(b"\n") + 1]
    for raw in whole.splitlines(keepends=True):
        number = end.number + 1
        line = _line(number, raw, end.previous)
        end = LogEnd(end.offset + len(raw), number, len(raw), _sha256(raw))
        yield line, end


def _sha256(raw: bytes) -> str:
    return hashlib.sha256(raw).hexdigest()


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
        return LogLine(number, None, "it cannot be read", raw=raw.rstrip(b"\n"))
    problem = "" if (said_before, said_number) == (previous, number) else "it does not follow the line before it"
    if not problem and raw != written:
        problem = "it is not as it was written: its text was altered"
    return LogLine(number, checkpoint, problem, message, key_id, signature, raw.rstrip(b"\n"))


def line_alone(raw: bytes) -> LogLine:
    """Return a line that was found without those before it: what it says of its own place is taken as said."""
    try:
        data = json.loads(raw)
        number, previous = int(data["number"]), str(data["previous_sha256"])
    except (ValueError, TypeError, KeyError, RecursionError):
        return LogLine(0, None, "it cannot be read", raw=raw)
    return _line(number, raw.rstrip(b"\n") + b"\n", previous)


def _message(number: int, previous: str, checkpoint: Checkpoint, key_id: str) -> bytes:
    return canonical_parsed(_fields(number, previous, checkpoint, key_id) | {"purpose": PURPOSE}).encode()


def _fields(number: int, previous: str, checkpoint: Checkpoint, key_id: str) -> dict[str, Any]:
    return {"number": number, "previous_sha256": previous, "checkpoint": asdict(checkpoint), "key_id": key_id}


def log_findings(
    lines: Sequence[LogLine] | None,
    present: Mapping[str, Sequence[Checkpoint]],
    public_keys: Mapping[str, bytes],
    *,
    awaited: bool,
) -> tuple[list[Fault], list[str]]:
    """Return faults and notes on differences between the log and the checkpoints of a database.

    Args:
        lines: the log's lines, oldest first; None if there is no log.
        present: the database's checkpoints by run; lines for other runs are not compared.
        public_keys: raw public keys by fingerprint.
        awaited: true if there must be a log, because something was signed here.
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
    newest = max((line.checkpoint.site_seq for line in lines if line.checkpoint is not None), default=0)
    unlogged = {place: item for place, item in here.items() if place not in held}
    if power_cut_explains(list(unlogged.values()), newest):
        return faults, [f"{run_id}: the signature at event {seq} is not in {NAME} yet" for run_id, seq in unlogged]
    faults += [Fault(run_id, seq, "", f"its signature is not in {NAME}") for run_id, seq in unlogged]
    return faults, []


def written_again_findings(
    said: Sequence[tuple[int, SignaturesWrittenAgain]], run_id: str | None
) -> tuple[list[Fault], list[str]]:
    """Return faults and notes on lines that were missing and were written again.

    What an interrupted signature does not explain stays a fault of the runs whose signatures these were.

    Args:
        said: the payloads of the site's chain that report them, with the numbers of their events.
        run_id: the run that is verified; None for all.
    """
    faults: list[Fault] = []
    notes: list[str] = []
    for seq, again in said:
        lines = "1 line was" if again.lines == 1 else f"{again.lines} lines were"
        since = f"of signatures since {again.since_utc}"
        what = f"{lines} missing from the end of {NAME}, {since}, and written again"
        if again.explained:
            notes.append(f"{SITE}, event {seq}: {what}, as after a power failure")
        elif run_id is None or run_id in again.runs:
            faults.append(Fault(SITE, seq, "", f"{what}: the log was cut, for no power failure explains it"))
        else:
            notes.append(f"{SITE}, event {seq}: {what}: the log was cut. None of them was of this run")
    return faults, notes


# What this process has seen of the signatures: each signature looks only at what is new since the one before.
#
# So the cost of a signature does not grow with the age of a site. The first look of a process reads everything.


_ROWID = literal_column("checkpoints.rowid").label("place")  # no row is ever removed, so it counts them
_NEW = (
    select(checkpoints, events.c.sha256.label("signed_sha256"), _ROWID)
    .outerjoin_from(
        checkpoints, events, (events.c.run_id == checkpoints.c.run_id) & (events.c.seq == checkpoints.c.seq)
    )
    .order_by(_ROWID)
)
_SIGNATURE = select(checkpoints.c.signature)
_KEYS = select(events.c.seq, events.c.payload).where(events.c.run_id == SITE, events.c.kind == "key_changed")
_HEAD = select(events.c.seq).where(events.c.run_id == SITE).order_by(events.c.seq.desc()).limit(1)


class SeenSignatures:
    """The checkpoints and the log of one data folder, compared as far as this process has seen them.

    What was compared is not read again, but the last line and the last checkpoint must still be there; if they are
    not, everything is read again.

    Attributes:
        there: true if there is a log.
        end: the end of the log, as far as it was read.
        missing: checkpoints without a line, oldest first.
        explained: true if an interrupted signature explains the missing lines.
        key_id: fingerprint of the key in use; "" before the first signature.
    """

    def __init__(self, log: SignatureLog) -> None:
        self._log = log
        self._one_look = Lock()
        self.forget()

    def forget(self) -> None:
        """Read everything again at the next look."""
        self.there = False
        self.end = LogEnd()
        self.missing: tuple[Checkpoint, ...] = ()
        self.explained = True
        self.key_id = ""
        self._last = (0, "")  # place and signature of the last checkpoint
        self._newest = 0  # the newest site_seq that has a line
        self._keys_until = 0  # event of the site's chain up to which changes of the key were looked for
        self._of_log: Fault | None = None
        self._of_run: dict[str, Fault] = {}

    def look(self, connection: Connection) -> None:
        """Read what is new in the log and among the checkpoints. Raises StoreError if the log cannot be read."""
        with self._one_look:
            read = self._log.lines_after(self.end) if self._still_there(connection) else None
            if read is None:
                self.forget()
                read = self._log.lines_after(self.end)
            # The log was read before the rows: a signature is a row before it is a line.
            self._read_rows(connection)
            self.there = read is not None
            if read is not None:
                lines, self.end = read
                self._compare(connection, lines)
            self.explained = power_cut_explains(self.missing, self._newest)
            self.key_id, self._keys_until = self.key_in_use(connection), connection.execute(_HEAD).scalar() or 0

    def made_since(self, connection: Connection) -> list[Checkpoint]:
        """Return the checkpoints that were made since the last look, oldest first."""
        return [to_checkpoint(row) for row in connection.execute(_NEW.where(self._last[0] < _ROWID))]

    def fault(self, run_id: str) -> Fault | None:
        """Return the fault of signatures or log that forbids signing this chain; None if there is none."""
        if not self.there and self.key_id:
            return Fault(None, None, NAME, "the log of signatures is missing: it was removed")
        return self._of_run.get(run_id) or self._of_log

    def _still_there(self, connection: Connection) -> bool:
        place, signature = self._last
        if not place:
            return True
        return connection.execute(_SIGNATURE.where(place == _ROWID)).scalar() == signature

    def _read_rows(self, connection: Connection) -> None:
        missing = list(self.missing)
        for row in connection.execute(_NEW.where(self._last[0] < _ROWID)):
            item = to_checkpoint(row)
            missing.append(item)
            self._last = row.place, item.signature
            if row.signed_sha256 != item.sha256:
                what = "a signature is for another event than the one that is here"
                self._of_run.setdefault(item.run_id, Fault(item.run_id, item.seq, "", what))
        self.missing = tuple(missing)

    def _compare(self, connection: Connection, lines: list[LogLine]) -> None:
        awaited = {(item.run_id, item.seq): item for item in self.missing}
        for line in lines:
            said = line.checkpoint
            if said is None or line.problem:
                self._of_log = self._of_log or Fault(None, None, f"{NAME}, line {line.number}", line.problem)
                continue
            here = awaited.pop((said.run_id, said.seq), None) or read_checkpoint(connection, said.run_id, said.seq)
            self._newest = max(self._newest, said.site_seq)
            if here != said:
                what = f"{NAME} holds another signature of this event, or one more"
                self._of_run.setdefault(said.run_id, Fault(said.run_id, said.seq, "", what))
        self.missing = tuple(awaited.values())

    def key_in_use(self, connection: Connection) -> str:
        """Return the fingerprint of the key in use; "" before the first signature."""
        found = self.key_id
        for row in connection.execute(_KEYS.where(events.c.seq > self._keys_until).order_by(events.c.seq)):
            try:
                found = str(parse_canonical(row.payload)["key_id"])
            except (ValueError, TypeError, LookupError):
                self._of_log = Fault(SITE, row.seq, "", "the change of the key cannot be read")
        return found
