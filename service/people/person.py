"""Records of people, accounts, screens and one-time links, what each role may do, and the errors of this room."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from service.core.errors import OrthocaptureError


class PeopleError(OrthocaptureError):
    """A person's request was refused; nothing was changed."""


class NotSignedInError(PeopleError):
    """Nobody is signed in on this screen, or the sign-in has ended."""


class SignInRefusedError(PeopleError):
    """Name or password is wrong, or the account may not sign in now; which of these is deliberately not said."""


class AccountJustChangedError(SignInRefusedError):
    """The password was right, but the account was changed meanwhile; this does not count as a failed try."""


class TooManyTriesError(PeopleError):
    """Too many failed tries from one address; `wait_s` says how long to wait."""

    wait_s: float = 60.0


class NotAllowedError(PeopleError):
    """The person's role does not have the permission, or the request did not come from the person's own page."""


class ScreenLockedError(PeopleError):
    """The screen is locked: it shows pages but allows no actions."""


class PinRefusedError(PeopleError):
    """The PIN is wrong."""


class LinkError(PeopleError):
    """A one-time link is unknown, used, or too old."""


class AccountError(PeopleError):
    """An account cannot be made or changed like this."""


class ControlError(PeopleError):
    """Another screen has control of the run, or nobody has."""


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
    """Return whether a role has a permission."""
    return permission in _GRANTED[role]


@dataclass(frozen=True, slots=True)
class Person:
    """A person signed in on one screen."""

    account: str
    full_name: str
    role: Role
    screen: str  # name of this sign-in, for people and for the record
    csrf: str = field(repr=False)  # token that every form of this sign-in carries
    locked: bool = False

    def may(self, permission: Permission) -> bool:
        """Return whether the person's role has a permission."""
        return may(self.role, permission)


@dataclass(frozen=True, slots=True)
class Account:
    """An account as administrators see it."""

    account: str
    full_name: str
    role: Role
    state: str  # invited, active, disabled
    failures: int  # wrong passwords in a row
    locked_until_utc_s: float  # 0 if not locked out
    created_utc: str
    badge: bool  # true if it has a badge


@dataclass(frozen=True, slots=True)
class Screen:
    """A sign-in that is still valid."""

    screen: str
    account: str
    created_utc_s: float
    seen_utc_s: float
    locked: bool


@dataclass(frozen=True, slots=True)
class Invitation:
    """The purpose of a one-time link. `account` is "" for the first administrator, who chooses a name."""

    account: str
    full_name: str
    role: Role
