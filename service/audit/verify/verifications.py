"""Verifying a run from the screen: started by a person, done by a process of its own, its result kept in a file.

The result is a note for people beside the data, not evidence: whoever doubts it verifies again.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from threading import Lock, Thread

from pydantic import ValidationError

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


@dataclass(frozen=True, slots=True)
class Verifying:
    """A verification under way, or one that ended without a result."""

    by: str
    since_utc: str
    what: str
    done: int
    total: int
    problem: str = ""


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
        self._running: dict[str, Verifying] = {}
        self._threads: dict[str, Thread] = {}
        self._lock = Lock()

    def last(self, run_id: str) -> Verification | None:
        """The last result; None when there is none that can be read."""
        try:
            return Verification.model_validate_json(_path(self._data, run_id).read_bytes())
        except (OSError, ValidationError):
            return None

    def running(self, run_id: str) -> Verifying | None:
        """How far the present one is; with a `problem`, why the last one gave no result."""
        with self._lock:
            return self._running.get(run_id)

    def start(self, run_id: str, by: str) -> None:
        """Begin one, unless one is under way."""
        with self._lock:
            now = self._running.get(run_id)
            if now is not None and not now.problem:
                return
            begun = Verifying(by, utc_text(self._clock.utc_now()), "starting", 0, 0)
            self._running[run_id] = begun
            thread = Thread(target=self._follow, args=(run_id, begun), name=f"verify {run_id}", daemon=True)
            self._threads[run_id] = thread
        thread.start()

    def wait(self, run_id: str, timeout_s: float) -> None:
        """Until the present one has ended."""
        thread = self._threads.get(run_id)
        if thread is not None:
            thread.join(timeout_s)

    def _follow(self, run_id: str, begun: Verifying) -> None:
        words = [sys.executable, "-m", "service.audit.verify.process", str(self._data), run_id]
        problem = "the verification ended without a result"
        try:
            with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
                assert process.stdout is not None  # a pipe was asked for
                for content in process.stdout:
                    line = json.loads(content)
                    if "result" in line:
                        self._keep(run_id, begun, line["result"])
                        problem = ""
                    elif "problem" in line:
                        problem = str(line["problem"])
                    else:
                        self._set(
                            run_id, Verifying(begun.by, begun.since_utc, line["what"], line["done"], line["total"])
                        )
        except (OSError, ValueError) as error:
            problem = f"the verification could not be done: {error}"
        self._set(run_id, Verifying(begun.by, begun.since_utc, "", 0, 0, problem) if problem else None)

    def _set(self, run_id: str, now: Verifying | None) -> None:
        with self._lock:
            if now is None:
                self._running.pop(run_id, None)
            else:
                self._running[run_id] = now

    def _keep(self, run_id: str, begun: Verifying, result: dict[str, object]) -> None:
        fields = {"at_utc": utc_text(self._clock.utc_now()), "by": begun.by, **result}
        kept = Verification.model_validate_json(json.dumps(fields))
        keep_verification(self._data, run_id, kept)
