"""Exports requested in the browser: each is made by a process of its own and kept in DIR/exports."""

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
    """A recorded export, and whether its file still exists."""

    seq: int
    at_utc: str
    actor: str
    record: EvidenceExported
    present: bool


class Exports:
    """The exports of a data folder in a web process; one at a time for each run."""

    def __init__(self, data: Path, clock: Clock) -> None:
        self._data = data
        self._clock = clock
        self._children = ChildProcesses("service.audit.export.process", "export", clock)

    @property
    def folder(self) -> Path:
        """The folder of the exported files."""
        return self._data / FOLDER

    def state(self, run_id: str) -> ChildState | None:
        """The state of a run's present or last export; its result is the file's name. None before the first."""
        return self._children.state(run_id)

    def start(self, run_id: str, export: What, by: str) -> None:
        """Start an export. Raises IllegalTransitionError while another export of the run is running."""
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
        """Wait until the present export has ended."""
        self._children.wait(run_id, timeout_s)

    def files(self, events: Sequence[Event]) -> list[ExportedFile]:
        """Every export of a run, newest first."""
        found = [
            ExportedFile(e.seq, e.at_utc, e.actor, e.payload, self._path(e.payload) is not None)
            for e in events
            if isinstance(e.payload, EvidenceExported)
        ]
        return found[::-1]

    def path(self, events: Sequence[Event], file_name: str) -> tuple[Path, EvidenceExported]:
        """A file for download, by its recorded name. Raises DataError for any other name."""
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
        """The file if it exists with the recorded size, else None; names that lead out of the folder are refused."""
        path = self.folder / record.file_name
        if path.parent != self.folder or path.name != record.file_name:
            return None
        try:
            found = path.lstat()
        except OSError:
            return None
        return path if stat.S_ISREG(found.st_mode) and found.st_size == record.size_bytes else None
