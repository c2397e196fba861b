"""Who may do what: one table of roles and permissions for every route."""

from __future__ import annotations

from typing import Literal

Role = Literal["technician", "supervisor", "auditor", "administrator"]
Permission = Literal[
    "read",  # every page of every run, audit pages included
    "operate",  # start and drive a run: tick, confirm, redo, skip, pause, resume, abort; take control
    "sign",  # sign a step
    "correct",  # correct a recorded value, with reason
    "release",  # release a completed run as second person
    "enrol",  # enrol and revoke people's badges
    "report",  # make a report or an evidence bundle
    "export",  # make a data set
    "administer",  # accounts, invitations, signing key
]
ROLES: tuple[Role, ...] = ("technician", "supervisor", "auditor", "administrator")
_GRANTED: dict[Role, frozenset[Permission]] = {
    "technician": frozenset({"read", "operate", "sign"}),
    "supervisor": frozenset({"read", "operate", "sign", "correct", "release", "report", "export", "enrol"}),
    "auditor": frozenset({"read", "report"}),
    "administrator": frozenset({"read", "administer", "enrol"}),
}


def may(role: Role, permission: Permission) -> bool:
    """Whether a role has a permission."""
    return permission in _GRANTED[role]
