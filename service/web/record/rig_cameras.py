"""The further cameras in the rig file of a run, which exist before any of them has taken an image."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from service.core.records.events import RunStarted
from service.rig import parse_recorded_rig
from service.run_record import RunRecord


def rig_cameras(log: RunRecord) -> tuple[str, ...]:
    """Their names, in the order of the rig file."""
    root = log.events[0].payload
    assert isinstance(root, RunStarted)  # checked when the record was read
    return _names(log.store.artefact_path(root.rig.sha256))


@lru_cache(maxsize=32)
def _names(path: Path) -> tuple[str, ...]:
    return tuple(parse_recorded_rig(path.read_bytes(), path).section.cameras)
