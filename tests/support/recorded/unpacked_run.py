"""Runs that earlier versions recorded, unpacked: that of 2026-11-23 has photographs, scans, CT and registrations."""

from __future__ import annotations

import tarfile
from pathlib import Path

FOLDER = Path(__file__).parents[2] / "data" / "recorded"
RECORDED = FOLDER / "2026-11-23.tar.xz"
PREVIOUS = FOLDER / "2026-11-28-schema-0005.tar.xz"  # a short run of the version before this one


def unpack_recorded_run(folder: Path, packed: Path = RECORDED) -> Path:
    """Unpack the data folder into `folder`. Returns it; its keys can sign."""
    with tarfile.open(packed) as archive:
        archive.extractall(folder, filter="data")
    data = folder / "data"
    for path in (data / "keys").rglob("*"):
        path.chmod(0o600)
    (data / "keys").chmod(0o700)
    return data
