"""`orthocapture accounts`: what an administrator can do about accounts without a browser."""

from __future__ import annotations

from typing import Annotated

import typer

from service.cli.common import DEFAULT_DATA, DataOption, JsonOption, console, print_json, reporting_errors
from service.cli.options import OperatorOption, PasswordOption, acting_person
from service.people.person import plain_name
from service.people.sessions import People
from service.store.records import SITE
from service.store.signatures.signing import checkpoint_here
from service.store.store import Store

accounts_app = typer.Typer(name="accounts", help="Maintain the accounts of a site.", no_args_is_help=True)


@accounts_app.callback()
def accounts() -> None:
    """Maintain the accounts of a site."""


@accounts_app.command("end-wait")
def end_wait_command(
    account: Annotated[str, typer.Argument(help="The account for which wrong passwords were given.")],
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    data: DataOption = DEFAULT_DATA,
    json: JsonOption = False,
) -> None:
    """End all waits after wrong passwords of an account, as its page does. Only an administrator may."""
    with reporting_errors(json), Store.open(data, create=False) as store:
        who = acting_person(store, operator, "administer", password_stdin=password_stdin)
        name = plain_name(account)
        People(store).accounts.end_wait(who.name, name)
        checkpoint_here(store, SITE)
        if json:
            print_json({"account": name, "wait": "ended"})
        else:
            console.print(f"Nobody has to wait any more for wrong passwords of {name}", markup=False)
