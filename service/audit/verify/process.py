"""Verifies one run in a process of its own, so that pages stay quick: `python -m service.audit.verify.process`.

Reads the data folder only. Its progress goes out line by line, its result last, as JSON.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

from service.audit.verify.verifications import LISTED
from service.core.errors import StoreError
from service.store.verification.verify import verify


def main(data: Path, run_id: str) -> None:
    """Write the lines."""
    begun = last = time.monotonic()

    def say(**line: Any) -> None:
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()

    def progress(what: str, done: int, total: int) -> None:
        nonlocal last
        if time.monotonic() - last > 0.2:
            last = time.monotonic()
            say(what=what, done=done, total=total)

    say(what="reading the events", done=0, total=0)
    try:
        report = verify(data, run_id, progress)
    except StoreError as error:
        say(problem=str(error))
        return
    faults = [
        {"run_id": fault.run_id, "seq": fault.seq, "file": fault.file, "what": fault.what} for fault in report.faults
    ]
    say(
        result={
            "ok": report.ok,
            "events": report.events,
            "artefacts": report.artefacts,
            "files": report.files,
            "bytes_hashed": report.bytes_hashed,
            "head_sha256": report.heads.get(run_id, ""),
            "faults": faults[:LISTED],
            "fault_count": len(faults),
            "notes": list(report.notes)[:LISTED],
            "duration_s": time.monotonic() - begun,
        }
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
