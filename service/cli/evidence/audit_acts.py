"""`orthocapture audit release` and `correct`: a second person's word on a completed run, and on a recorded value."""

from __future__ import annotations

from typing import Annotated

import typer

from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    RunArgument,
    RunOption,
    console,
    print_json,
    progress_bar,
    reporting_errors,
)
from service.cli.run.person import OperatorOption, PasswordOption, acting_person
from service.core.errors import IntegrityError
from service.core.gates.release import release_meaning
from service.people.authorisation import Identity
from service.people.person import ROLES, NotAllowedError, Permission, may
from service.run_acts import release_run, require_releasable
from service.run_record import read_log
from service.run_start import recorded_run
from service.store.store import Store
from service.store.verification import verify as audit


def release_command(
    run: RunArgument = "latest",
    data: DataOption = DEFAULT_DATA,
    yes: Annotated[
        bool, typer.Option("--yes", help="You have read the run: sign the words that this command shows otherwise.")
    ] = False,
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    json: JsonOption = False,
) -> None:
    """Release a completed run as its second person, so that it may be exported; the evidence is verified first.

    Without --yes, nothing is recorded, and the words that would be signed are shown.
    """
    with reporting_errors(json), Store.open(data, create=False) as store:
        run_id = store.find_run(run)
        protocol, _ = recorded_run(store, run_id)
        log = read_log(store, run_id, protocol)
        meaning, signed = release_meaning(log.state), log.state.completed_sha256
        who = Identity("", "", "claimed")
        if yes:
            who = acting_person(store, operator, password_stdin=password_stdin)
            _require(who, "release")
            require_releasable(log.state, who.name, meaning, signed)
            _require_verified(store, run_id, quiet=json)
            identified = "claimed" if who.identified == "claimed" else "password"
            release_run(log, meaning, signed, actor=who.name, identified=identified)
    if json:
        print_json({"run": run_id, "released": yes, "meaning": meaning, "signed_sha256": signed})
    elif yes:
        console.print(f"Run {run_id} is released by {who.name}: {meaning}")
    else:
        console.print(f"Not released yet. With --yes you sign, for run {run_id}: {meaning}")


def correct_command(
    event: Annotated[int, typer.Argument(help="Number of the event that holds the value.", min=1)],
    field: Annotated[str, typer.Argument(help="The field, such as environment.light_lux.")],
    value: Annotated[str, typer.Argument(help="The right value.")],
    reason: Annotated[str, typer.Option("--reason", help="Why; it goes into the record.")],
    run: RunOption = "latest",
    data: DataOption = DEFAULT_DATA,
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    json: JsonOption = False,
) -> None:
    """Correct a recorded value. The original stays, and readers see both, with who, when and why."""
    from service.audit.overview.corrections import correct  # noqa: PLC0415 - `verify` does not need the overview

    with reporting_errors(json), Store.open(data, create=False) as store:
        run_id = store.find_run(run)
        who = acting_person(store, operator, password_stdin=password_stdin)
        _require(who, "correct")
        made = correct(store, run_id, of_seq=event, field=field, new=value, reason=reason, actor=who.name)
    if json:
        print_json({"run": run_id, "event": made.seq, "of_event": event, "field": field})
    else:
        console.print(f"Recorded as event {made.seq}: {field} of event {event} is {value}")


def _require(who: Identity, permission: Permission) -> None:
    """Raise NotAllowedError if the person's role does not permit it; a mere claim means a site without accounts."""
    if who.identified == "claimed":
        return
    if not any(role == who.role and may(role, permission) for role in ROLES):
        roles = " or ".join(role for role in ROLES if may(role, permission))
        raise NotAllowedError(f"{who.name} may not do this", where=permission, remedy=f"Call a {roles}")


def _require_verified(store: Store, run_id: str, *, quiet: bool) -> None:
    with progress_bar(quiet=quiet) as progress:
        found = audit.verify(store.database_path.parent, run_id, progress)
    if found.first_fault is not None:
        raise IntegrityError(
            f"the evidence does not verify: {found.first_fault}", where=run_id, remedy="Nothing is released"
        )
