"""Who acts at this terminal: the options for a name and a password, and asking for the password."""

from __future__ import annotations

import getpass
import sys
from typing import Annotated

import typer

from service.core.errors import ConfigurationError

OperatorOption = Annotated[str, typer.Option("--operator", help="Your name, as it goes into the record.")]
PasswordOption = Annotated[
    bool, typer.Option("--password-stdin", help="Read the password, if one is needed, from stdin.")
]


def typed_password(name: str, *, from_stdin: bool) -> str:
    """A password from the keyboard, or the next line of stdin. Raises ConfigurationError if none is given."""
    if from_stdin:
        return sys.stdin.readline().rstrip("\n")
    try:
        return getpass.getpass(f"Password of {name}: ")
    except EOFError as error:
        raise ConfigurationError("no password was given", remedy="Type it, or give --password-stdin") from error
