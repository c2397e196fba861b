"""Grants of memory as the workers of a machine write them."""

from __future__ import annotations

from pathlib import Path

import psutil

from service.computations.memory_grants import Grant
from service.store.runs import ProcessIdentity


def write_grant(
    folder: Path, pid: int, job: str, memory_mb: float, *, waits: str = "", place: int = 0, alone: bool = False
) -> Path:
    """Write the grant of another process, or what it waits for; return the file."""
    here = ProcessIdentity.of_this_process()
    started_s = here.process_started_s
    if psutil.pid_exists(pid):
        started_s = psutil.Process(pid).create_time() - psutil.boot_time()
    grant = Grant(
        host=here.host,
        boot=here.boot,
        pid=pid,
        process_started_s=started_s,
        job=job,
        memory_mb=memory_mb,
        waits=waits,
        place=place,
        alone=alone,
    )
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{here.host}-{pid}.json"
    path.write_text(grant.model_dump_json(), encoding="utf-8")
    return path
