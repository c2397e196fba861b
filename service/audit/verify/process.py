"""Verifies a run in a process of its own, so that pages stay fast: `python -m service.audit.verify.process`.

It only reads the data folder, and ends when the process that started it ends.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from service.audit.background.child_process import Progress, report
from service.audit.verify.verifications import LISTED, Outcome, VerifiedFault
from service.store.verification.verify import verify


def verification(data: Path, run_id: str, progress: Progress) -> Outcome:
    """Verify a run. Raises StoreError."""
    begun_s = time.monotonic()
    progress("reading the events", 0, 0)
    found = verify(data, run_id, progress)
    faults = [VerifiedFault(run_id=f.run_id, seq=f.seq, file=f.file, what=f.what) for f in found.faults[:LISTED]]
    return Outcome(
        ok=found.ok,
        events=found.events,
        artefacts=found.artefacts,
        files=found.files,
        bytes_hashed=found.bytes_hashed,
        head_sha256=found.heads.get(run_id, ""),
        faults=tuple(faults),
        fault_count=len(found.faults),
        notes=tuple(found.notes[:LISTED]),
        duration_s=time.monotonic() - begun_s,
    )


def _told(progress: Progress) -> object:
    return verification(Path(sys.argv[1]), sys.argv[2], progress).model_dump(mode="json")


if __name__ == "__main__":
    report(_told, outlives_parent=False)
