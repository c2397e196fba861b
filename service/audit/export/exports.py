"""Exports asked for on the screen: started by a person, made by a process of its own, kept in DIR/exports."""

from __future__ import annotations

import json
import stat
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock, Thread
from typing import Literal

from service.core.errors import DataError, IllegalTransitionError
from service.core.records.events import Event, EvidenceExported
from service.store.durable_effects import Clock, utc_text

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
class Exporting:
    """An export under way, or how the last one ended."""

    export: What
    by: str
    since_utc: str
    what: str
    done: int
    total: int
    problem: str = ""  # why nothing was exported
    remedy: str = ""
    file_name: str = ""  # when it is ready

    @property
    def pending(self) -> bool:
        """Whether it is still under way."""
        return not self.problem and not self.file_name


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
        self._now: dict[str, Exporting] = {}
        self._threads: dict[str, Thread] = {}
        self._lock = Lock()

    @property
    def folder(self) -> Path:
        """Where the files lie."""
        return self._data / FOLDER

    def now(self, run_id: str) -> Exporting | None:
        """How far the present export of a run is, or how the last one ended."""
        with self._lock:
            return self._now.get(run_id)

    def start(self, run_id: str, export: What, by: str) -> None:
        """Begin one. Raises IllegalTransitionError while another of the run is under way."""
        self.folder.mkdir(exist_ok=True)
        with self._lock:
            now = self._now.get(run_id)
            if now is not None and now.pending:
                raise IllegalTransitionError(
                    f"{now.by} is exporting this run already", where=run_id, remedy="Wait until that one is ready"
                )
            begun = Exporting(export, by, utc_text(self._clock.utc_now()), "starting", 0, 0)
            self._now[run_id] = begun
            at = f"{self._clock.utc_now():%Y%m%d-%H%M%S}"
            target = self.folder / f"{run_id}-exported-{at}-{_SUFFIX[export]}"
            thread = Thread(target=self._follow, args=(run_id, begun, target), name=f"export {run_id}", daemon=True)
            self._threads[run_id] = thread
        thread.start()

    def wait(self, run_id: str, timeout_s: float) -> None:
        """Until the present one has ended."""
        thread = self._threads.get(run_id)
        if thread is not None:
            thread.join(timeout_s)

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

    def _follow(self, run_id: str, begun: Exporting, target: Path) -> None:
        words = [sys.executable, "-m", "service.audit.export.process"]
        words += [str(self._data), run_id, begun.export, str(target), begun.by]
        ended = _ended(begun, problem="the export ended without a result", remedy="Look at the list, and try again")
        try:
            with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
                assert process.stdout is not None  # a pipe was asked for
                for content in process.stdout:
                    line = json.loads(content)
                    if "result" in line:
                        ended = _ended(begun, file_name=str(line["result"]))
                    elif "problem" in line:
                        problem = line["problem"]
                        ended = _ended(begun, problem=str(problem["what"]), remedy=str(problem["remedy"]))
                    else:
                        self._set(run_id, _ended(begun, what=line["what"], done=line["done"], total=line["total"]))
        except (OSError, ValueError) as error:
            ended = _ended(begun, problem=f"the export could not be done: {error}")
        self._set(run_id, ended)

    def _set(self, run_id: str, now: Exporting) -> None:
        with self._lock:
            self._now[run_id] = now


def _ended(
    begun: Exporting,
    *,
    what: str = "",
    done: int = 0,
    total: int = 0,
    problem: str = "",
    remedy: str = "",
    file_name: str = "",
) -> Exporting:
    return Exporting(begun.export, begun.by, begun.since_utc, what, done, total, problem, remedy, file_name)
