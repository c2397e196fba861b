"""`orthocapture dicom-listen` as a process, for whole runs to which a simulated CT suite sends."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from tests.support.processes.forked import Forked
from tests.support.rig.rig import REPOSITORY, command


@contextmanager
def dicom_listener(folder: Path) -> Generator[str]:
    """Listen for CTSUITE into a folder; yields HOST:PORT."""
    folder.mkdir(parents=True, exist_ok=True)
    words = command("dicom-listen", "--port", "0", "--json", "--folder", str(folder), "--from", "CTSUITE")
    process = Forked(words, cwd=REPOSITORY, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        yield f"127.0.0.1:{json.loads(process.stdout.readline())['port']}"
    finally:
        process.terminate()
        process.communicate(timeout=60)
