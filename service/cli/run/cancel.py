"""`orthocapture cancel`: ends one computation of a run; nothing else of the run is touched."""

from __future__ import annotations

from typing import Annotated

import typer

from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    RunOption,
    console,
    print_json,
    reporting_errors,
)
from service.cli.run.person import OperatorOption, PasswordOption, acting_person
from service.core.errors import ConfigurationError
from service.jobs.words import term
from service.run_acts import cancel_computation
from service.store.records import Job
from service.store.store import Store


def cancel_command(
    job: Annotated[str, typer.Argument(help="The computation, as `status` names it, or its first characters.")],
    reason: Annotated[str, typer.Option("--reason", help="Why; it goes into the record.")],
    run: RunOption = "latest",
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    data: DataOption = DEFAULT_DATA,
    json: JsonOption = False,
) -> None:
    """End one computation of a run. The step that waits for it asks what to do, as if it had failed."""
    with reporting_errors(json), Store.open(data, create=False) as store:
        run_id = store.find_run(run)
        chosen = _open_job(store, run_id, job)
        name = acting_person(store, operator, password_stdin=password_stdin).name
        event = cancel_computation(store, run_id, chosen.job_id, reason, actor=name)
        if json:
            print_json({"run": run_id, "cancelled": chosen.job_id, "event": event.seq})
        else:
            console.print(f"Cancelled: {term(chosen.kind)} of step {chosen.step} by {name}")


def _open_job(store: Store, run_id: str, name: str) -> Job:
    """The job that a name or its first characters mean. Raises ConfigurationError."""
    found = [job for job in store.jobs(run_id) if job.state in ("queued", "running") and job.job_id.startswith(name)]
    if len(found) != 1:
        what = f"{len(found)} computations of the run begin with" if found else "no computation of the run is called"
        raise ConfigurationError(
            f"{what} {name!r}", where=run_id, remedy="`orthocapture status` lists those that wait or run"
        )
    return found[0]
