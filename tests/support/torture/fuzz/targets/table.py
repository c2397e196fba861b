"""The table of all fuzz targets: every parser of the project, in groups that are imported separately."""

from __future__ import annotations

import importlib
from typing import cast

from tests.support.torture.fuzz.targets.target import Target

_MODULES = (  # each has a tuple TARGETS
    "files.written", "files.delivered", "files.labelled", "files.viewed", "files.exported",
    "records", "wires.streams", "wires.devices", "wires.movers", "wires.hostile",
)  # fmt: skip
GROUPS = tuple(f"tests.support.torture.fuzz.targets.{name}" for name in _MODULES)


def targets_of(group: str) -> tuple[Target, ...]:
    """Import the parsers of one group and return its targets."""
    return cast("tuple[Target, ...]", importlib.import_module(group).TARGETS)


def table() -> dict[str, tuple[str, Target]]:
    """All targets with their group, by name."""
    return {target.name: (group, target) for group in GROUPS for target in targets_of(group)}
