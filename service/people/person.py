"""Records of people, accounts, screens and one-time links, without their secrets."""

from __future__ import annotations

from dataclasses import dataclass, field

from service.people.roles import Permission, Role, may


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
        """Whether the person's role has a permission."""
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
    badge: bool  # whether it has a badge


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
