"""The arms that are known, by the names that their controllers state; each one is an entry point."""

from __future__ import annotations

from difflib import get_close_matches
from functools import cache

from service.core.arms.model import ArmModel
from service.core.declared_kinds import plug_ins
from service.core.errors import ConfigurationError

GROUP = "orthocapture.arms"


@cache
def known_arms() -> tuple[ArmModel, ...]:
    """All arms, ordered by name of their entry points."""
    found: list[ArmModel] = []
    for point in plug_ins(GROUP):
        arm: object = point.load()
        if not isinstance(arm, ArmModel):
            raise ConfigurationError(
                f"the entry point {point.name} of {GROUP} is not an ArmModel",
                where=point.value,
                remedy="Let it name an ArmModel, or remove the package that has it",
            )
        found.append(arm)
    return tuple(found)


def arm_model(name: str) -> ArmModel:
    """The arm of this name, in upper or lower case.

    Raises:
        ConfigurationError: the name is unknown.
    """
    by_name = {arm.name.lower(): arm for arm in known_arms()}
    if name.lower() in by_name:
        return by_name[name.lower()]
    near = get_close_matches(name.lower(), by_name, n=1)
    hint = f"did you mean {by_name[near[0]].name}? " if near else ""
    known = ", ".join(arm.name for arm in by_name.values())
    raise ConfigurationError(f"no kinematics are known for an arm {name!r}", remedy=f"{hint}known are {known}")


def known_arm(name: str) -> ArmModel | None:
    """The arm of this name, or None if it is not known."""
    return next((arm for arm in known_arms() if arm.name.lower() == name.lower()), None)
