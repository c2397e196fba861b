"""One rule says what a reason is, wherever a person has to give one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.audit.findings import correct
from service.cli.main import app
from service.core.errors import OrthocaptureError
from service.core.records.entered import REASON_CHARACTERS
from service.people.control import Control
from service.run_acts import cancel_computation
from service.store.records import NewJob
from service.store.store import Store
from tests.support.record.office import Office
from tests.support.runs.bench_run import PROTOCOL, begin_run

TOO_LONG = "x" * (REASON_CHARACTERS + 1)


@pytest.fixture
def run(office: Office, tmp_path: Path) -> str:
    run_id = begin_run(office.store, PROTOCOL, tmp_path).run_id
    office.store.record(run_id, [], actor="runner", jobs=[NewJob("detect", "capture", 1, "key", {})])
    return run_id


def _act(store: Store, run: str, verb: str, reason: str) -> None:
    words = ["act", verb, "--reason", reason, "--operator", "grace", "--password-stdin"]
    data = str(store.database_path.parent)
    done = CliRunner().invoke(app, [*words, "--run", run, "--data", data], input="correct horse grace\n")
    if done.exit_code:
        raise OrthocaptureError(done.output)


PLACES: dict[str, Callable[[Office, str, str], object]] = {
    "computation": lambda office, run, reason: cancel_computation(
        office.store, run, office.store.jobs(run)[0].job_id, reason, actor="grace"
    ),
    "correction": lambda office, run, reason: correct(
        office.store, run, of_seq=1, field="operator", new="Somebody", reason=reason, actor="emmy"
    ),
    "account": lambda office, _run, reason: office.people.accounts.disable(office.enter("ada")[1], "grace", reason),
    "control": lambda office, run, reason: Control(office.store).take_over(run, office.enter("emmy")[1], reason),
    "skip": lambda office, run, reason: _act(office.store, run, "skip", reason),
    "end": lambda office, run, reason: _act(office.store, run, "abort", reason),
}


@pytest.mark.slow
@pytest.mark.parametrize("place", PLACES)
def test_a_reason_says_something_and_is_no_book(office: Office, run: str, place: str) -> None:
    for typed in ("  ", TOO_LONG):
        with pytest.raises(OrthocaptureError, match="reason"):
            PLACES[place](office, run, typed)
    PLACES[place](office, run, "no")
