"""The copies of the log of signatures and of the journal in a second place, such as a network share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from service.core.errors import IntegrityError, StoreError
from service.store.database.engine import LOOK
from service.store.durable_effects import DurableFiles, Files
from service.store.journal.copies import journal_copy, journal_copy_faults, keep_journal
from service.store.signatures.log import NAME
from service.store.verification.chain_checks import Fault

_FILES = DurableFiles()


def keep_elsewhere(data_dir: Path, copy: Path | None, tell: Callable[[str], object], files: Files = _FILES) -> None:
    """Bring the copies up to date, if there is a second place. `tell` is told of a problem; nothing is raised."""
    if copy is None:
        return
    try:
        bring_up_to_date(data_dir, copy, files)
        keep_journal(data_dir, journal_copy(copy), files)
    except StoreError as error:
        tell(f"the copy in the second place: {error}")


def bring_up_to_date(data_dir: Path, copy: Path, files: Files = _FILES) -> None:
    """Append to `copy` the lines of the log that it lacks. A copy with other content is left as it is.

    Raises:
        IntegrityError: the copy is not a beginning of the log: one of them was changed.
        StoreError: the copy cannot be written; the next call will add what is missing.
    """
    log = _bytes(data_dir / NAME)
    held = _whole_lines(_bytes(copy))
    if not log.startswith(held):
        raise IntegrityError(
            "the copy of the log of signatures is not the beginning of the log: one of the two was changed",
            where=str(copy),
            remedy="Keep both; see `orthocapture audit verify --signatures`. Each data folder needs its own copy",
        )
    try:
        if not copy.exists():
            files.write(copy, ())
            files.sync_directory(copy.parent)
        files.append(copy, len(held), log[len(held) :])  # overwrites a partly written line
        files.sync_file(copy)
    except OSError as error:
        raise StoreError(
            f"the copy of the log of signatures cannot be written: {error.strerror or error}",
            where=str(copy),
            remedy="Check that the share or the medium is there and that it has space",
        ) from error


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


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return b""
    except OSError as error:
        raise StoreError(
            f"the log of signatures cannot be read: {error.strerror}", where=str(path), remedy=LOOK
        ) from error
