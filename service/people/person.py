"""Who acts, and what is known of accounts, screens and one-time links: plain records without secrets of sign-in."""

from __future__ import annotations

from dataclasses import dataclass, field

from service.people.roles import Permission, Role, may


@dataclass(frozen=True, slots=True)
class Person:
    """Somebody signed in, on one screen."""

    account: str
    full_name: str
    role: Role
    screen: str  # name of this sign-in, for people and for the record
    csrf: str = field(repr=False)  # every form of this sign-in carries it
    locked: bool = False

    def may(self, permission: Permission) -> bool:
        """Whether the person's role has a permission."""
        return may(self.role, permission)


@dataclass(frozen=True, slots=True)
class Account:
    """An account as the administrator sees it."""

    account: str
    full_name: str
    role: Role
    state: str  # invited, active, disabled
    failures: int  # wrong passwords in a row
    locked_until_utc_s: float  # 0 for not locked out
    created_utc: str
    badge: bool = False  # has one


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
    """What a one-time link is for. `account` is "" for the first administrator, who chooses a name."""

    account: str
    full_name: str
    role: Role
