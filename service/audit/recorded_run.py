"""Reads a run from the evidence, read-only, with the results that had not arrived."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from service.core.errors import IntegrityError
from service.core.protocol import Protocol, parse_protocol
from service.core.records.events import Event
from service.core.records.run_events import RunStarted
from service.core.run.fold import FoldedRun, fold
from service.core.run.state import RunState
from service.people.person import full_names, named
from service.steps import params_models
from service.store.artefacts import ArtefactFiles, read_artefacts
from service.store.database.opening import open_read_only
from service.store.durable_effects import DurableFiles, RandomIds
from service.store.events import read_events
from service.store.objects.reading import SpoolReader
from service.store.records import Artefact
from service.store.runs import read_runs, resolve_run

if TYPE_CHECKING:
    from service.dataset.summary import RunSummary


class RecordedFiles:
    """Read-only access to the files of a data folder."""

    def __init__(self, data_dir: Path) -> None:
        folder = ArtefactFiles(data_dir / "artefacts", DurableFiles(), RandomIds())
        self._files = SpoolReader(data_dir, folder)

    def artefact_path(self, sha256: str, *, verify: bool = False) -> Path:
        """Return the file of an artefact. Raises IntegrityError if it is missing or, with `verify`, altered."""
        return self._files.path(sha256, verify=verify)


@dataclass(frozen=True, slots=True)
class RecordedRun(FoldedRun):
    """A run and its files."""

    data_dir: Path
    artefacts: Sequence[Artefact]
    files: RecordedFiles
    full_names: Mapping[str, str]  # full names by account, as they are now

    def summary(self) -> RunSummary:
        """Return the run as the functions of the report and of the data set take it."""
        from service.dataset.summary import RunSummary  # noqa: PLC0415 - loads the numerics, which a bundle does without

        return RunSummary(self.run_id, self.protocol, self.events, self.state, self.files)

    def named(self, account: str) -> str:
        """Return a person by full name and account; a person without an account by the recorded name."""
        return named(account, self.full_names)


def read_run(data_dir: Path, name: str, *, last_seq: int | None = None) -> RecordedRun:
    """Read a run by its name, the beginning of its name, or `latest`; all of it, or up to the event `last_seq`.

    Raises:
        UnknownRunError: there is no such run.
        StoreError: there is no database, or it cannot be read as one.
        IntegrityError: its events cannot have happened, or its protocol file is missing or altered.
    """
    database = open_read_only(data_dir, DurableFiles())
    try:
        with database.reading() as connection:
            run_id = resolve_run(read_runs(connection), name)
            events = read_events(connection, run_id, 0)
            artefacts = read_artefacts(connection, run_id)
            names = full_names(connection)
    finally:
        database.close()
    if last_seq is not None:
        events = [event for event in events if event.seq <= last_seq]
        artefacts = [artefact for artefact in artefacts if artefact.seq <= last_seq]
    root = events[0].payload if events else None
    if not isinstance(root, RunStarted):
        raise IntegrityError("the run's first event is not run_started", where=run_id)
    files = RecordedFiles(data_dir)
    content = files.artefact_path(root.protocol.sha256, verify=True).read_bytes()
    loaded = parse_protocol(content, params_models(), name=root.protocol.original_name)
    state = fold(loaded.protocol, events)
    return RecordedRun(run_id, loaded.protocol, events, state, data_dir, artefacts, files, names)


def not_in_yet(protocol: Protocol, state: RunState, events: Sequence[Event]) -> list[str]:
    """Return lines such as `COLMAP from scratch: was still being computed`; empty if every result has arrived.

    The same events give the same lines, so the time that is left is not among them.
    """
    from service.steps.due_jobs import missing_results  # noqa: PLC0415 - as in service.run_record

    return [
        f"{left.what}: {f'there will be none, {left.failed}' if left.failed else 'was still being computed'}"
        for left in missing_results(protocol, state, {}, events[-1].at_utc, 1)
    ]
