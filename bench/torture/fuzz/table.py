"""The table of all targets: every parser of the project, in groups that are imported apart."""

from __future__ import annotations

import importlib
from typing import Literal, cast, get_args

from bench.torture.fuzz.target import Target

Group = Literal["written", "delivered", "records", "wires"]
GROUPS: tuple[Group, ...] = get_args(Group)


def targets_of(group: Group) -> tuple[Target, ...]:
    """The targets of one group; its parsers are imported now."""
    return cast("tuple[Target, ...]", importlib.import_module(f"bench.torture.fuzz.{group}").TARGETS)


def table() -> dict[str, tuple[Group, Target]]:
    """Every target with its group, by name."""
    return {target.name: (group, target) for group in GROUPS for target in targets_of(group)}
