"""Verifications started in the browser: each is done by a process of its own, and the result is stored in a file.

The result is a note beside the data, not evidence: if in doubt, verify again.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from pydantic import ValidationError

from service.audit.background import ChildProcesses, ChildState, Progress, report
from service.core.records.base import Record
from service.store.durable_effects import Clock, utc_text
from service.store.verification.chain_checks import NOT_COMPARED, Fault
from service.store.verification.verify import AuditReport, verify

LISTED = 500  # most faults listed in a result


class Outcome(Record):
    """The findings of a verification."""

    ok: bool
    events: int
    artefacts: int
    files: int
    bytes_hashed: int
    head_sha256: str  # hash of the last event that it covered
    faults: tuple[Fault, ...]
    fault_count: int
    notes: tuple[str, ...]
    duration_s: float
    not_compared: tuple[str, ...] = ()  # what could not be compared with the anchors in the object store

    @property
    def limits(self) -> list[str]:
        """The notes on what the verification could not judge."""
        return [note for note in self.notes if NOT_COMPARED in note]


class Verification(Outcome):
    """The result of the last verification of a run, when it was done, and who asked for it."""

    at_utc: str
    by: str


def keep_verification(data: Path, run_id: str, kept: Verification) -> None:
    """Write a result to the file that the pages read. Raises OSError."""
    path = _path(data, run_id)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.part")
    temporary.write_text(kept.model_dump_json())
    temporary.replace(path)


def verification_of(report: AuditReport, run_id: str, *, by: str, at_utc: str, duration_s: float) -> Verification:
    """Return the result for one run of a report; the counts are those of all runs that were verified together."""
    faults = [fault for fault in report.faults if fault.run_id in (None, run_id)]
    return Verification(at_utc=at_utc, by=by, **dict(_outcome(report, run_id, faults, duration_s)))


def _outcome(report: AuditReport, run_id: str, faults: Sequence[Fault], duration_s: float) -> Outcome:
    together = [f"verified together with {len(report.runs) - 1} other runs"] if len(report.runs) > 1 else []
    return Outcome(
        ok=not faults,
        events=report.events,
        artefacts=report.artefacts,
        files=report.files,
        bytes_hashed=report.bytes_hashed,
        head_sha256=report.heads.get(run_id, ""),
        faults=tuple(faults[:LISTED]),
        fault_count=len(faults),
        notes=(*together, *report.notes)[:LISTED],
        duration_s=duration_s,
        not_compared=report.not_compared,
    )


def _path(data: Path, run_id: str) -> Path:
    return data / "monitor" / f"{run_id}.verification.json"


class Verifications:
    """The verifications of a data folder in a web process."""

    def __init__(self, data: Path, clock: Clock) -> None:
        self._data = data
        self._clock = clock
        self._children = ChildProcesses("service.audit.verifications", "verification", clock)

    def last(self, run_id: str) -> Verification | None:
        """Return the last result; None if there is none that can be read."""
        try:
            return Verification.model_validate_json(_path(self._data, run_id).read_bytes())
        except (OSError, ValidationError):
            return None

    def running(self, run_id: str) -> ChildState | None:
        """Return the state of the present verification; `problem` says why the last one gave no result."""
        state = self._children.state(run_id)
        return state if state is not None and state.result is None else None

    def start(self, run_id: str, by: str) -> None:
        """Start a verification, unless one is running."""
        self._children.start(run_id, [str(self._data), run_id], by=by, keep=lambda ended: self._keep(run_id, ended))

    def wait(self, run_id: str, timeout_s: float) -> None:
        """Wait until the present verification has ended."""
        self._children.wait(run_id, timeout_s)

    def _keep(self, run_id: str, ended: ChildState) -> None:
        fields = {"at_utc": utc_text(self._clock.utc_now()), "by": ended.by, **ended.result}
        keep_verification(self._data, run_id, Verification.model_validate_json(json.dumps(fields)))


# Verifies a run in a process of its own, so that pages stay fast: `python -m service.audit.verifications`.
#
# It only reads the data folder, and ends when the process that started it ends.


def verification(data: Path, run_id: str, progress: Progress) -> Outcome:
    """Verify a run. Raises StoreError."""
    begun_s = time.monotonic()
    progress("reading the events", 0, 0)
    found = verify(data, run_id, progress).with_limits()
    return _outcome(found, run_id, found.faults, time.monotonic() - begun_s)


def _told(progress: Progress) -> object:
    return verification(Path(sys.argv[1]), sys.argv[2], progress).model_dump(mode="json")


if __name__ == "__main__":
    report(_told, outlives_parent=False)
