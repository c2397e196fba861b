"""Options that several commands share: who acts at this terminal, and what a run is of and for."""

from __future__ import annotations

import getpass
import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from service.core.errors import ConfigurationError
from service.core.records.entered import RunAbout, about_run, require_specimen
from service.core.words import shown
from service.people.person import Permission
from service.people.sessions import Identity, People, who_acts
from service.store.store import Store

OperatorOption = Annotated[str, typer.Option("--operator", help="Your name, as it goes into the record.")]
PasswordOption = Annotated[
    bool, typer.Option("--password-stdin", help="Read the password, if one is needed, from stdin.")
]


def acting_person(store: Store, operator: str, permission: Permission, *, password_stdin: bool) -> Identity:
    """Return the person who acts at this terminal: the given name, or that of the machine's user.

    The name of an account needs its password, and its role must have the permission.

    Raises:
        ConfigurationError: no password was given.
        NotAllowedError: nobody has this name, or the person's role does not permit this.
        SignInRefusedError: name and password do not belong together.
    """
    name = operator or getpass.getuser()
    return who_acts(People(store), name, partial(typed_password, name, from_stdin=password_stdin), permission)


def typed_password(name: str, *, from_stdin: bool) -> str:
    """Return a password from the keyboard, or the next line of stdin. Raises ConfigurationError if none is given."""
    if from_stdin:
        return sys.stdin.readline().rstrip("\n")
    try:
        return getpass.getpass(f"Password of {shown(name)}: ")
    except EOFError as error:
        raise ConfigurationError("no password was given", remedy="Type it, or give --password-stdin") from error


def acting_name(data: Path, operator: str, permission: Permission, *, password_stdin: bool) -> str:
    """Return the name of the person who acts on a data folder. Raises StoreError, and as `acting_person`."""
    with Store.open(data, create=False) as store:
        return acting_person(store, operator, permission, password_stdin=password_stdin).name


SpecimenOption = Annotated[
    str,
    typer.Option("--specimen", help="What is captured: name or number of the specimen, which a person must give."),
]
PurposeOption = Annotated[str, typer.Option("--purpose", help="What the run is for.")]
SiteOption = Annotated[str, typer.Option("--site", help="Where it takes place.")]
RemarksOption = Annotated[str, typer.Option("--remarks", help="Anything else for the record.")]


def described(specimen: str, *, purpose: str, site: str, remarks: str) -> RunAbout:
    """Return what a person enters about a run; ask for the specimen in a terminal if it is not given.

    Raises ConfigurationError if it is not named, or a text is too long.
    """
    if not specimen.strip() and sys.stdin.isatty():
        specimen = typer.prompt("Specimen, name or number", default="", show_default=False, err=True)
    about = about_run(specimen=specimen, purpose=purpose, site=site, text=remarks)
    require_specimen(about)
    return about
