"""The run of a demo that was recorded on 2026-11-23, unpacked: real photographs, scans, CT and registrations."""

from __future__ import annotations

import tarfile
from pathlib import Path

RECORDED = Path(__file__).parents[2] / "data" / "recorded" / "2026-11-23.tar.xz"


def unpack_recorded_run(folder: Path) -> Path:
    """Unpack the data folder into `folder`. Returns it; its keys can sign."""
    with tarfile.open(RECORDED) as archive:
        archive.extractall(folder, filter="data")
    data = folder / "data"
    for path in (data / "keys").rglob("*"):
        path.chmod(0o600)
    (data / "keys").chmod(0o700)
    return data
