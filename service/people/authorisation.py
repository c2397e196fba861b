"""Who somebody is when an action demands a role: by a secret of an account, or by claim where there are none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from service.core.gates.acceptance import demanded_role
from service.core.protocol.models import Protocol
from service.core.run.state import RunState
from service.people.errors import NotAllowedError
from service.people.rows import plain_name
from service.people.sessions import KnownBy, People


@dataclass(frozen=True, slots=True)
class Identity:
    """A person as an event names them, and how the program knows."""

    name: str
    role: str
    identified: Literal["claimed", "password", "pin", "badge"]


def identity_for(
    people: People,
    protocol: Protocol,
    state: RunState,
    verb: str,
    typed: str,
    secret: Callable[[], str],
    known_by: KnownBy = "password",
) -> Identity | None:
    """Who acts, for a verb that demands a role now; None for the others. Raises as `identify` does."""
    role = demanded_role(protocol, state) if verb == "accept" else ""
    return identify(people, typed, role, secret, known_by) if role else None


def who_acts(people: People, typed: str, password: Callable[[], str]) -> Identity:
    """Who acts on the command line, where a name is a claim: that of an account needs its password.

    Raises SignInRefusedError: name and password do not belong together, or the account is not in use.
    """
    name = plain_name(typed)
    account = next((account for account in people.accounts.all() if account.account == name), None)
    if account is None:
        return Identity(typed.strip(), "", "claimed")
    people.check_password(name, password())
    return Identity(name, account.role, "password")


def identify(
    people: People, typed: str, role: str, secret: Callable[[], str], known_by: KnownBy = "password"
) -> Identity:
    """The person of this name, in this role.

    Args:
        people: accounts of the data folder.
        typed: name as it was typed.
        role: what the action demands.
        secret: asks for it; not called on a site that has no accounts, where a name is a claim.
        known_by: what the secret is: the account's password, PIN or badge.

    Raises:
        SignInRefusedError: name and secret do not belong together.
        NotAllowedError: no name was given, or the account has another role.
    """
    if not typed.strip():
        raise NotAllowedError("a name is needed", where="name", remedy=f"Give the name of the {role}")
    if not any(account.state == "active" for account in people.accounts.all()):
        return Identity(typed.strip(), role, "claimed")
    name = plain_name(typed)
    people.check_secret(name, known_by, secret())
    account = people.accounts.get(name)
    if account.role != role:
        raise NotAllowedError(f"{name} is {account.role}; this needs a {role}", where="role", remedy=f"Call a {role}")
    return Identity(name, account.role, known_by)
