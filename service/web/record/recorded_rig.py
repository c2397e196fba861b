"""The rig file of a run, as it was when the run began."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from service.core.records.events import RunStarted
from service.rig import RigSection, parse_recorded_rig
from service.run_record import RunRecord


def recorded_rig_section(log: RunRecord) -> RigSection:
    """What the rig file of the run says. Raises ConfigurationError if this version cannot read it."""
    root = log.events[0].payload
    assert isinstance(root, RunStarted)  # checked when the record was read
    return _section(log.store.artefact_path(root.rig.sha256))


def rig_cameras(log: RunRecord) -> tuple[str, ...]:
    """The names of its further cameras, in their order; they exist before any of them has taken an image."""
    return tuple(recorded_rig_section(log).cameras)


@lru_cache(maxsize=32)
def _section(path: Path) -> RigSection:
    return parse_recorded_rig(path.read_bytes(), path).section
