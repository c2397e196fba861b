"""The copies of the log of signatures and of the journal in a second place, such as a network share."""

from __future__ import annotations

import os
from pathlib import Path

from service.core.errors import IntegrityError, StoreError
from service.store.durable_effects import DurableFiles, Files
from service.store.journal.copies import journal_copy, journal_copy_faults
from service.store.signatures.log import NAME, copying_alone, unreadable
from service.store.verification.chain_checks import Fault

_FILES = DurableFiles()


class LogCopy:
    """A copy of a file of lines to which lines are only appended.

    What was compared is not read again, but for the last line of it.
    """

    def __init__(self, source: Path, copy: Path, files: Files = _FILES) -> None:
        self.source = source
        self.copy = copy
        self._files = files
        self._same = 0  # bytes at the beginning of both that are the same: whole lines
        self._last = b""  # the last of these lines

    def bring_up_to_date(self) -> None:
        """Append to the copy the lines that it lacks. A copy with other content is left as it is.

        Raises:
            IntegrityError: the copy is not a beginning of the source: one of them was changed.
            StoreError: the copy cannot be written; the next call will add what is missing.
        """
        with copying_alone(self.source):
            self._update()

    def _update(self) -> None:
        start = self._same - len(self._last)
        ours, theirs = _bytes(self.source, start), _bytes(self.copy, start)
        if not (ours.startswith(self._last) and theirs.startswith(self._last)):
            start, self._same, self._last = 0, 0, b""
            ours, theirs = _bytes(self.source), _bytes(self.copy)
        ours, held = _whole_lines(ours), _whole_lines(theirs)
        if not ours.startswith(held):
            raise IntegrityError(
                "the copy of the log of signatures is not the beginning of the log: one of the two was changed",
                where=str(self.copy),
                remedy="Keep both; see `orthocapture audit verify --signatures`. Each data folder needs its own copy",
            )
        try:
            if not self.copy.exists():
                self._files.write(self.copy, ())
                self._files.sync_directory(self.copy.parent)
            if theirs != ours:
                self._files.append(self.copy, start + len(held), ours[len(held) :])  # over a partly written line
                self._files.sync_file(self.copy)
            elif not os.access(self.copy, os.W_OK):
                raise PermissionError(None, "it is read-only", str(self.copy))
        except OSError as error:
            raise StoreError(
                f"the copy of the log of signatures cannot be written: {error.strerror or error}",
                where=str(self.copy),
                remedy="Check that the share or the medium is there and that it has space",
            ) from error
        self._same = start + len(ours)
        self._last = ours[ours.rfind(b"\n", 0, -1) + 1 :]


def copy_faults(data_dir: Path, copy: Path) -> tuple[list[Fault], list[str]]:
    """Faults and notes on differences between the log and its copy, and between the journal and the copy beside it.

    Raises:
        StoreError: the copy is missing or cannot be read.
    """
    if not copy.exists():
        raise StoreError(
            "there is no such copy of the log of signatures", where=str(copy), remedy="Name the copy of this folder"
        )
    # The copy first: a signature made meanwhile is in the log before it is in the copy.
    held, log = (_whole_lines(_bytes(path)).splitlines(keepends=True) for path in (copy, data_dir / NAME))
    for number, line in enumerate(held, start=1):
        if number > len(log):
            what = f"{NAME} ends before line {number} of its copy: it was cut, and the record perhaps with it"
            return [Fault(None, None, str(copy), what)], []
        if log[number - 1] != line:
            return [Fault(None, None, f"{NAME}, line {number}", f"it is not the line that {copy} holds")], []
    missing = len(log) - len(held)
    notes = [f"{copy} does not have the last {missing} lines of {NAME} yet"] if missing else []
    return list(journal_copy_faults(data_dir, journal_copy(copy))), notes


def _whole_lines(content: bytes) -> bytes:
    return content[: content.rfind(b"\n") + 1]


def _bytes(path: Path, offset: int = 0) -> bytes:
    try:
        with path.open("rb") as stream:
            if offset:
                stream.seek(offset)
            return stream.read()
    except FileNotFoundError:
        return b""
    except OSError as error:
        raise unreadable(path, error) from error
