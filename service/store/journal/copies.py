"""The copy of the journal in the second place, beside the copy of the log of signatures."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

from service.core.errors import IntegrityError, StoreError
from service.store.durable_effects import Files
from service.store.journal.journal import Tail, read_tail
from service.store.journal.lines import NAME
from service.store.signatures.log import NAME as LOG_NAME
from service.store.signatures.log import copying_alone
from service.store.verification.chain_checks import Fault

_BLOCK_BYTES = 1 << 22


def journal_copy(signature_copy: Path) -> Path:
    """The path of the copy of the journal, from that of the copy of the log of signatures."""
    return signature_copy.with_name(f"{signature_copy.stem}.{NAME}")


class JournalCopy:
    """The copy of the journal of a data folder; service.store.signatures.second_place.KeptCopy."""

    def __init__(self, data_dir: Path, copy: Path, files: Files) -> None:
        self._journal = data_dir / NAME
        self.copy = copy
        self._files = files

    def bring_up_to_date(self) -> None:
        """Append to the copy the lines that it lacks, once something was signed.

        Only its owner can read it, as it holds what the database holds. One process writes to it at a time: the lock
        is that of the log of signatures, as for its copy, because the journal's own would keep its writers waiting.

        Raises:
            IntegrityError: the copy is not a beginning of the journal: one of them was changed.
            StoreError: the copy cannot be written; the next call adds what is missing.
        """
        log = self._journal.with_name(LOG_NAME)
        with copying_alone(log):
            if not log.exists():
                return  # nothing was signed yet
            try:
                self._append()
            except OSError as error:
                raise StoreError(
                    f"the copy of the journal cannot be written: {error.strerror or error}",
                    where=str(self.copy),
                    remedy="Check that the share or the medium is there and that it has space",
                ) from error

    def _append(self) -> None:
        end, held = read_tail(self._journal), read_tail(self.copy)
        if end is None:
            return
        if held is not None and not _has(self._journal, held):
            raise IntegrityError(
                "the copy of the journal is not the beginning of the journal: one of the two was changed",
                where=str(self.copy),
                remedy="Keep both. If `orthocapture store rebuild` made the journal anew, rename this copy",
            )
        if not self.copy.exists():
            self._files.write(self.copy, (), private=True)
            self._files.sync_directory(self.copy.parent)
        begin = 0 if held is None else held.end
        with self._journal.open("rb") as stream:
            stream.seek(begin)
            while begin < end.end:
                block = stream.read(min(_BLOCK_BYTES, end.end - begin))
                self._files.append(self.copy, begin, block)  # overwrites a partly written line
                begin += len(block)
        self._files.sync_file(self.copy)


def journal_copy_faults(data_dir: Path, copy: Path) -> Iterator[Fault]:
    """Faults of the journal that its copy shows; none if there is no copy. Raises StoreError.

    Each line holds the hash of the one before it, so the copy's last line stands for all of them.
    """
    try:
        held, end = read_tail(copy), read_tail(data_dir / NAME)  # the copy first: lines may be written meanwhile
        if held is None:
            return
        if end is None or end.number < held.number:
            what = f"{NAME} ends before line {held.number} of its copy: it was cut, and the record perhaps with it"
            yield Fault(None, None, str(copy), what)
        elif not _has(data_dir / NAME, held):
            yield Fault(None, None, f"{NAME}, line {held.number}", f"it is not the line that {copy} holds")
    except OSError as error:
        raise StoreError(
            f"the journal cannot be compared with its copy: {error.strerror or error}",
            where=str(copy),
            remedy="Check that the share or the medium is there",
        ) from error


def _has(journal: Path, line: Tail) -> bool:
    """Whether a journal has this line at the same place."""
    with journal.open("rb") as stream:
        stream.seek(line.start)
        return hashlib.sha256(stream.read(line.end - line.start)).hexdigest() == line.sha256
