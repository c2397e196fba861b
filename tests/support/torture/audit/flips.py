"""Flips one bit of every byte of the record: database, write-ahead log, signature log, journal, artefacts."""

from __future__ import annotations

import os
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

from service.store.database.engine import database_path
from service.store.signatures.log import NAME
from service.store.verification.file_checks import wal_findings
from tests.support.torture.audit import outcome
from tests.support.torture.audit.outcome import Verdict, verdict
from tests.support.torture.audit.record import WAL_NAME, Record, put_back
from tests.support.torture.audit.tally import Tallies, Tally


@contextmanager
def flipped(path: Path, offset: int) -> Generator[None]:
    """Flip one bit of the byte at `offset` within the context: bit `offset` modulo 8, so that every bit occurs."""
    descriptor = os.open(path, os.O_RDWR)
    try:
        byte = os.pread(descriptor, 1, offset)
        os.pwrite(descriptor, bytes([byte[0] ^ 1 << offset % 8]), offset)
        try:
            yield
        finally:
            os.pwrite(descriptor, byte, offset)
    finally:
        os.close(descriptor)


class DatabaseFlips:
    """Bit flips in the database, with or without a write-ahead log beside it."""

    def __init__(self, record: Record, *, wal: bool) -> None:
        put_back(record)
        self._record = record
        self.name = "flip in the write-ahead log" if wal else "flip in the database"
        self._path = database_path(record.data)
        self._wal = wal
        if wal:
            database, log, signatures, journal = record.with_wal
            self._path.write_bytes(database)
            record.journal.write_bytes(journal)
            (record.data / NAME).write_bytes(signatures)
            self._path = record.data / WAL_NAME
            self._path.write_bytes(log)
        self.size = self._path.stat().st_size
        before = outcome.content_of(record.data)
        if isinstance(before, str) or outcome.damage_of(record.data) != "ok":
            raise ValueError(f"the record cannot be read before anything is altered: {before}")
        self._before = before
        self._columns = outcome.columns_of(record.data)
        self._terms = outcome.search_terms(record.data)
        self._found = outcome.search_content(record.data, self._terms)
        whole = outcome.audit.verify(record.data)
        if whole.faults:
            raise ValueError(f"the record does not verify before anything is altered: {whole.faults[0]}")
        self._notes = whole.notes
        self._known: dict[str, tuple[Verdict, set[str]]] = {}

    def part(self, offsets: Sequence[int]) -> Tallies:
        """Flip the bytes at these offsets, one at a time; returns the tallies."""
        tally = Tally()
        original = self._path.read_bytes()
        for offset in offsets:
            if self._wal:
                self._path.with_name(self._path.name.replace("-wal", "-shm")).unlink(missing_ok=True)
            with flipped(self._path, offset):
                self._one(tally, offset)
        if self._path.read_bytes() != original:
            raise ValueError(f"{self._path} was written to while it was only read")
        return {self.name: tally}

    def _one(self, tally: Tally, offset: int) -> None:
        now = outcome.content_of(self._record.data)
        if now == self._before and not self._wal and outcome.damage_of(self._record.data) == "ok":
            tally.number += 1
            tally.meaningless += 1
            return
        name = f"byte {offset}, bit {offset % 8}"
        if self._wal:  # an invalid frame ends the log, so very many flips give few distinct contents
            key = repr((now, wal_findings(self._record.data)))
            if key not in self._known:
                found = verdict(self._record, self._notes)
                self._known[key] = found, set() if found.told else self._codes(now)
            found, codes = self._known[key]
            tally.count(found, name, lambda: codes)
        else:
            tally.count(verdict(self._record, self._notes), name, lambda: self._codes(now))

    def _codes(self, now: outcome.Content | str) -> set[str]:
        codes = outcome.differences(self._before, now, self._columns)
        if self._wal and codes:
            return {"last commit of the write-ahead log"}
        if codes and all(code.startswith(outcome.WORDS) for code in codes):
            same = outcome.search_content(self._record.data, self._terms) == self._found
            return set() if same else codes
        return codes


class LineFlips:
    """Bit flips in a file of lines: the log of signatures, or the journal."""

    def __init__(self, record: Record, path: Path, code: str) -> None:
        put_back(record)
        self.name = f"flip in {path.name}"
        self._record = record
        self._path = path
        self._code = code
        self.size = self._path.stat().st_size
        self._notes = outcome.audit.verify(record.data).notes

    def part(self, offsets: Sequence[int]) -> Tallies:
        """Flip the bytes at these offsets, one at a time; returns the tallies."""
        tally = Tally()
        for offset in offsets:
            with flipped(self._path, offset):
                found = verdict(self._record, self._notes)
                tally.count(found, f"byte {offset}", lambda: {self._code})
        return {self.name: tally}


class ArtefactFlips:
    """Bit flips in the artefacts: the same byte of every file that is long enough, each of which must be named."""

    name = "flip in an artefact"

    def __init__(self, record: Record) -> None:
        put_back(record)
        self._record = record
        self._files = sorted(path for path in (record.data / "artefacts").rglob("*") if path.is_file())
        for path in self._files:
            path.chmod(0o644)
        self._sizes = {path: path.stat().st_size for path in self._files}
        self.size = max(self._sizes.values())

    def part(self, offsets: Sequence[int]) -> Tallies:
        """Flip the bytes at these offsets in every file, one offset at a time; returns the tallies."""
        tally = Tally()
        for offset in offsets:
            self._one(tally, offset)
        return {self.name: tally}

    def _one(self, tally: Tally, offset: int) -> None:
        altered = [path for path in self._files if offset < self._sizes[path]]
        for path in altered:
            _flip(path, offset)
        try:
            report = outcome.audit.verify(self._record.data)
        finally:
            for path in altered:
                _flip(path, offset)
        named = {fault.file for fault in report.faults if fault.seq is not None}
        for path in altered:
            shown = str(path.relative_to(self._record.data))
            tally.count(Verdict(shown in named, shown in named), f"{shown}, byte {offset}", lambda: {"artefacts"})


def _flip(path: Path, offset: int) -> None:
    descriptor = os.open(path, os.O_RDWR)
    try:
        byte = os.pread(descriptor, 1, offset)
        os.pwrite(descriptor, bytes([byte[0] ^ 1 << offset % 8]), offset)
    finally:
        os.close(descriptor)
