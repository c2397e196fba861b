"""Verifying a run from the screen: started by a person, done by a process of its own, its result kept in a file.

The result is a note for people beside the data, not evidence: whoever doubts it verifies again.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

from pydantic import ValidationError

from service.audit.background.child_process import ChildProcesses, ChildState
from service.core.records.events import Record
from service.store.durable_effects import Clock, utc_text
from service.store.verification.verify import AuditReport

LISTED = 500  # faults that a result spells out


class VerifiedFault(Record):
    """One thing that did not verify."""

    run_id: str | None
    seq: int | None
    file: str
    what: str


class Verification(Record):
    """What the last verification of a run found."""

    at_utc: str
    by: str
    ok: bool
    events: int
    artefacts: int
    files: int
    bytes_hashed: int
    head_sha256: str  # of the last event that it covered
    faults: tuple[VerifiedFault, ...]
    fault_count: int
    notes: tuple[str, ...]
    duration_s: float


def keep_verification(data: Path, run_id: str, kept: Verification) -> None:
    """Put a result where the pages find it. Raises OSError."""
    path = _path(data, run_id)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.part")
    temporary.write_text(kept.model_dump_json())
    temporary.replace(path)


def verification_of(report: AuditReport, run_id: str, *, by: str, at_utc: str, duration_s: float) -> Verification:
    """What a report says of one of its runs; its counts are those of all that were verified together."""
    faults = [fault for fault in report.faults if fault.run_id in (None, run_id)]
    together = [f"verified together with {len(report.runs) - 1} other runs"] if len(report.runs) > 1 else []
    return Verification(
        at_utc=at_utc,
        by=by,
        ok=not faults,
        events=report.events,
        artefacts=report.artefacts,
        files=report.files,
        bytes_hashed=report.bytes_hashed,
        head_sha256=report.heads.get(run_id, ""),
        faults=tuple(VerifiedFault(run_id=f.run_id, seq=f.seq, file=f.file, what=f.what) for f in faults[:LISTED]),
        fault_count=len(faults),
        notes=(*together, *report.notes)[:LISTED],
        duration_s=duration_s,
    )


def _path(data: Path, run_id: str) -> Path:
    return data / "monitor" / f"{run_id}.verification.json"


class Verifications:
    """Of one data folder, in one web process."""

    def __init__(self, data: Path, clock: Clock) -> None:
        self._data = data
        self._clock = clock
        self._children = ChildProcesses("service.audit.verify.process", "verification", clock)

    def last(self, run_id: str) -> Verification | None:
        """The last result; None when there is none that can be read."""
        try:
            return Verification.model_validate_json(_path(self._data, run_id).read_bytes())
        except (OSError, ValidationError):
            return None

    def running(self, run_id: str) -> ChildState | None:
        """How far the present one is; with a `problem`, why the last one gave no result."""
        state = self._children.state(run_id)
        return state if state is not None and state.result is None else None

    def start(self, run_id: str, by: str) -> None:
        """Begin one, unless one is under way."""
        self._children.start(run_id, [str(self._data), run_id], by=by, keep=lambda ended: self._keep(run_id, ended))

    def wait(self, run_id: str, timeout_s: float) -> None:
        """Until the present one has ended."""
        self._children.wait(run_id, timeout_s)

    def _keep(self, run_id: str, ended: ChildState) -> None:
        fields = {"at_utc": utc_text(self._clock.utc_now()), "by": ended.by, **ended.result}
        keep_verification(self._data, run_id, Verification.model_validate_json(json.dumps(fields)))
