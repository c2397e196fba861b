"""The page of the roles: who may do what, and who may accept figures outside their limits."""

from __future__ import annotations

from typing import get_args

from service.people.person import ROLES, Permission, may

_MEANINGS = {
    "read": "every page of every run, the audit's included",
    "operate": "start and drive a run: tick, confirm, redo, skip, pause, resume, end; take control",
    "sign": "sign a step, also without control of the run",
    "correct": "correct a recorded value, with a reason; the original stays",
    "release": "release a completed run as second person",
    "enrol": "give people badges, and take them away",
    "report": "make a report or an evidence bundle",
    "export": "make a data set",
    "administer": "accounts, invitations, the signing key",
}
_MORE = """\
A signature asks for the password again, or for a PIN or a badge where the rig file allows it (`signing`). It binds
the hash of what was signed, and is an event of the run.

- **A step** with `sign: true` is signed by a technician or a supervisor before it passes.
- **Figures outside their limits** are accepted only if the gate says so. `accept_by: supervisor` is any
  supervisor; `accept_by: another_supervisor` is one who neither began the run nor confirmed the step. The reason
  is listed with every result, as a deviation. Some measures can never be accepted, such as `moved_during_exposure`.
- **A release** is given by a supervisor who took no part in the run (`release: second_person` in the protocol).
  Whoever took control, signed or accepted took part, and is told so before. The evidence is verified first. Before
  the release nothing but a report can be exported, and that says so.
- **A protocol** is approved, by its bytes, by the first person who begins a run with it. Changed content under the
  same id and version needs a reason and a password.
"""


def roles_text() -> str:
    """A Markdown page."""
    permissions: tuple[Permission, ...] = get_args(Permission)
    rows = [
        f"| {permission} | {_MEANINGS[permission]} | "
        + " | ".join("yes" if may(role, permission) else "" for role in ROLES) + " |"
        for permission in permissions
    ]  # fmt: skip
    head = [f"| permission | what | {' | '.join(ROLES)} |", f"|---|---|{'---|' * len(ROLES)}"]
    return "\n".join(["# Roles", "", "Made from the code by `make reference`.", "", *head, *rows, "", _MORE])
