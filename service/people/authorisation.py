"""Identify the person who acts: by a secret of their account, or by claim on a site without accounts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from service.core.errors import ConfigurationError
from service.core.gates import demanded_role
from service.core.protocol import Protocol
from service.core.records.entered import cleaned_name, person_name
from service.core.run.state import RunState
from service.people.person import ROLES, NotAllowedError, Permission, may
from service.people.rows import plain_name
from service.people.sessions import KnownBy, People
from service.people.tries import TERMINAL, SecretOrigin


@dataclass(frozen=True, slots=True)
class Identity:
    """A person as named in an event, and how they were identified."""

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
    origin: SecretOrigin = TERMINAL,
) -> Identity | None:
    """Return the person who acts, if the verb now needs a role; else None.

    Raises:
        SignInRefusedError: name and secret do not belong together.
        NotAllowedError: no name was given, or the account has another role.
    """
    role = demanded_role(protocol, state) if verb == "accept" else ""
    return identify(people, typed, role, secret, known_by, origin) if role else None


def who_acts(people: People, typed: str, password: Callable[[], str], permission: Permission) -> Identity:
    """Return the person who acts on the command line: by password where there are accounts, else by claim.

    Args:
        people: accounts of the data folder.
        typed: the name as typed.
        password: asks for the password; not called on a site without accounts.
        permission: the permission that the act needs of the role, as on the pages.

    Raises:
        NotAllowedError: there are accounts, and none has this name, or its role does not permit this; or there are
            none, and this is no person's name.
        SignInRefusedError: name and password do not belong together, or the account is not in use.
    """
    accounts = {account.account: account.role for account in people.accounts.all()}
    if not accounts:
        return Identity(_claimed(typed), "", "claimed")
    name = plain_name(typed)
    if name not in accounts:
        raise NotAllowedError(
            f"only accounts act here, and {typed!r} is none",
            where="name",
            remedy="Give the name of your account with --operator; an administrator makes one on the page Accounts",
        )
    people.check_password(name, password())
    role = accounts[name]
    permitted = [each for each in ROLES if may(each, permission)]
    if role not in permitted:
        raise NotAllowedError(
            f"{name} is {role} and may not do this",
            where=permission,
            remedy=f"Call somebody whose role is {' or '.join(permitted)}",
        )
    return Identity(name, role, "password")


def who_pauses(people: People, typed: str) -> Identity:
    """Identify whoever pauses a run, without a password and whatever the name: pausing is always safe.

    Where there are accounts, the record says that the name was only claimed.
    """
    name = cleaned_name(typed)
    return Identity(f"claimed:{name}" if people.accounts.all() else name, "", "claimed")


def identify(
    people: People,
    typed: str,
    role: str,
    secret: Callable[[], str],
    known_by: KnownBy = "password",
    origin: SecretOrigin = TERMINAL,
) -> Identity:
    """Identify the person of this name in this role.

    Args:
        people: accounts of the data folder.
        typed: the name as typed.
        role: the role that the action needs.
        secret: asks for the secret; not called on a site without accounts, where the name is a claim.
        known_by: the kind of secret: the account's password, PIN or badge.
        origin: the place where the secret is typed.

    Raises:
        SignInRefusedError: name and secret do not belong together.
        NotAllowedError: no name was given, or none that a person can have, or the account has another role.
    """
    if not typed.strip():
        raise NotAllowedError("a name is needed", where="name", remedy=f"Give the name of the {role}")
    if not people.accounts.all():
        return Identity(_claimed(typed), role, "claimed")
    name = plain_name(typed)
    people.check_secret(name, known_by, secret(), origin)
    account = people.accounts.get(name)
    if account.role != role:
        raise NotAllowedError(f"{name} is {account.role}; this needs a {role}", where="role", remedy=f"Call a {role}")
    return Identity(name, account.role, known_by)


def _claimed(typed: str) -> str:
    """Return a name on a site without accounts. Raises NotAllowedError if it is no person's name."""
    try:
        return person_name(typed)
    except ConfigurationError as error:
        raise NotAllowedError(error.what, where=error.where, remedy=error.remedy) from error
