"""Exports asked for on the screen: started by a person, made by a process of its own, kept in DIR/exports."""

from __future__ import annotations

import stat
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from service.audit.background.child_process import ChildProcesses, ChildState
from service.core.errors import DataError, IllegalTransitionError
from service.core.records.events import Event, EvidenceExported
from service.store.durable_effects import Clock

FOLDER = "exports"
What = Literal["bundle", "hashes", "dataset", "report", "report_pdf"]
_SUFFIX: dict[What, str] = {
    "bundle": "bundle.zip",
    "hashes": "bundle-hashes.zip",
    "dataset": "dataset.zip",
    "report": "report.html",
    "report_pdf": "report.pdf",
}


@dataclass(frozen=True, slots=True)
class ExportedFile:
    """One recorded export, and whether its file is still here."""

    seq: int
    at_utc: str
    actor: str
    record: EvidenceExported
    present: bool


class Exports:
    """Of one data folder, in one web process; one at a time for each run."""

    def __init__(self, data: Path, clock: Clock) -> None:
        self._data = data
        self._clock = clock
        self._children = ChildProcesses("service.audit.export.process", "export", clock)

    @property
    def folder(self) -> Path:
        """Where the files lie."""
        return self._data / FOLDER

    def state(self, run_id: str) -> ChildState | None:
        """How far the present export of a run is, or how the last one ended: its result is the file's name."""
        return self._children.state(run_id)

    def start(self, run_id: str, export: What, by: str) -> None:
        """Begin one. Raises IllegalTransitionError while another of the run is under way."""
        self.folder.mkdir(exist_ok=True)
        at = f"{self._clock.utc_now():%Y%m%d-%H%M%S}"
        target = self.folder / f"{run_id}-exported-{at}-{_SUFFIX[export]}"
        if not self._children.start(run_id, [str(self._data), run_id, export, str(target), by], by=by):
            now = self._children.state(run_id)
            raise IllegalTransitionError(
                f"{now.by if now else 'somebody'} is exporting this run already",
                where=run_id,
                remedy="Wait until that one is ready",
            )

    def wait(self, run_id: str, timeout_s: float) -> None:
        """Until the present one has ended."""
        self._children.wait(run_id, timeout_s)

    def files(self, events: Sequence[Event]) -> list[ExportedFile]:
        """Everything that was exported of a run, newest first."""
        found = [
            ExportedFile(e.seq, e.at_utc, e.actor, e.payload, self._path(e.payload) is not None)
            for e in events
            if isinstance(e.payload, EvidenceExported)
        ]
        return found[::-1]

    def path(self, events: Sequence[Event], file_name: str) -> tuple[Path, EvidenceExported]:
        """A file for download, by its recorded name. Raises DataError for any other."""
        for file in self.files(events):
            path = self._path(file.record) if file.record.file_name == file_name else None
            if path is not None:
                return path, file.record
        raise DataError(
            "no exported file of this run has this name here",
            where=file_name[:200],
            remedy="Choose one of the list, or export again",
        )

    def _path(self, record: EvidenceExported) -> Path | None:
        """The file, when it is here and has the recorded size; a name that leads elsewhere is none."""
        path = self.folder / record.file_name
        if path.parent != self.folder or path.name != record.file_name:
            return None
        try:
            found = path.lstat()
        except OSError:
            return None
        return path if stat.S_ISREG(found.st_mode) and found.st_size == record.size_bytes else None
