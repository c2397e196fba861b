"""The machine and the revision of a measurement."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).parents[1]
RESULTS = REPOSITORY / "bench" / "results"


def machine() -> dict[str, Any]:
    """The hardware and software on which the durations were measured."""
    cpu = Path("/proc/cpuinfo")
    models = [s for s in cpu.read_text().splitlines() if s.startswith("model name")] if cpu.exists() else []
    return {
        "processor": models[0].split(":", 1)[1].strip() if models else platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "memory_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        "system": platform.system(),
        "python": platform.python_version(),
    }


def commit() -> str:
    """The measured revision, with `+` appended if the working tree differs from it."""
    answer = subprocess.run(
        ["git", "describe", "--always", "--dirty=+"], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    return answer.stdout.strip() or "unknown"
