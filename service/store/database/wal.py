"""Find commits in a database's write-ahead log that SQLite would silently ignore.

SQLite reads the log up to the first frame with a wrong checksum and takes the rest for a write cut off by a power
failure. After a damaged frame, however, whole commits may follow. The format is described in
https://sqlite.org/fileformat2.html#walformat.
"""

from __future__ import annotations

import struct
from pathlib import Path

from service.core.errors import StoreError
from service.store.database.engine import DATABASE_NAME, LOOK
from service.store.verification.chain_checks import Fault

_HEADER = struct.Struct(">8I")
_FRAME = struct.Struct(">6I")
_MAGIC = 0x377F0682  # the last bit gives the byte order of the checksum
_WORD = 0xFFFFFFFF
_HEAD_DAMAGED = -1


def wal_findings(data_dir: Path) -> tuple[list[Fault], list[str]]:
    """Return faults and notes on commits that SQLite ignores. Raises StoreError if the log cannot be read.

    One such commit may be the rest of a write cut off by a power failure, because frames need not reach the disk in
    order; it is a note. Two or more mean damage, because a commit begins only when the one before it is on disk.
    """
    log = data_dir / f"{DATABASE_NAME}-wal"
    # Read again if something is found, because a process may be writing to the log.
    commits = _passed_over(log) and _passed_over(log)
    if commits == _HEAD_DAMAGED:
        return [Fault(None, None, log.name, "its head is damaged: what was committed last is lost")], []
    if commits == 1:
        return [], [f"{log.name}: a commit behind a damaged frame is not read, as after a power cut"]
    return (
        [Fault(None, None, log.name, f"{commits} commits behind a damaged frame are lost")] if commits else []
    ), []


def _passed_over(log: Path) -> int:
    """Return the number of commits after a damaged frame of a write-ahead log, or _HEAD_DAMAGED; 0 without a log."""
    try:
        content = log.read_bytes()
    except FileNotFoundError:
        return 0
    except OSError as error:
        raise StoreError(
            f"the write-ahead log cannot be read: {error.strerror}", where=str(log), remedy=LOOK
        ) from error
    if len(content) <= _HEADER.size:
        return 0
    magic, _format, page, _checkpoint, *salts, one, two = _HEADER.unpack_from(content)
    order = ">" if magic & 1 else "<"
    sums = _checksum(content[:24], (0, 0), order)
    if magic & ~1 != _MAGIC or sums != (one, two):
        return _HEAD_DAMAGED
    size = _FRAME.size + page
    commits, sound = 0, True
    for start in range(_HEADER.size, len(content) - size + 1, size):
        _number, pages, *of_frame, one, two = _FRAME.unpack_from(content, start)
        if sound:
            sums = _checksum(content[start : start + 8], sums, order)
            sums = _checksum(content[start + _FRAME.size : start + size], sums, order)
            sound = of_frame == salts and sums == (one, two)
        if not sound and of_frame == salts and pages:  # frames with other salts are from an earlier use of the file
            commits += 1
    return commits


def _checksum(data: bytes, sums: tuple[int, int], order: str) -> tuple[int, int]:
    one, two = sums
    words = struct.unpack(f"{order}{len(data) // 4}I", data)
    for first, second in zip(words[::2], words[1::2], strict=True):
        one = (one + first + two) & _WORD
        two = (two + second + one) & _WORD
    return one, two
