"""Verifies a run in a process of its own, so that pages stay fast: `python -m service.audit.verify.process`.

It only reads the data folder, and ends when the process that started it ends.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from service.audit.background.child_process import Progress, report
from service.audit.verify.verifications import LISTED
from service.store.verification.verify import verify


def verification(data: Path, run_id: str, progress: Progress) -> dict[str, object]:
    """Verify a run. Returns the fields of a `Verification`. Raises StoreError."""
    begun_s = time.monotonic()
    progress("reading the events", 0, 0)
    found = verify(data, run_id, progress)
    faults = [
        {"run_id": fault.run_id, "seq": fault.seq, "file": fault.file, "what": fault.what} for fault in found.faults
    ]
    return {
        "ok": found.ok,
        "events": found.events,
        "artefacts": found.artefacts,
        "files": found.files,
        "bytes_hashed": found.bytes_hashed,
        "head_sha256": found.heads.get(run_id, ""),
        "faults": faults[:LISTED],
        "fault_count": len(faults),
        "notes": list(found.notes)[:LISTED],
        "duration_s": time.monotonic() - begun_s,
    }


if __name__ == "__main__":
    report(lambda progress: verification(Path(sys.argv[1]), sys.argv[2], progress), outlives_parent=False)
