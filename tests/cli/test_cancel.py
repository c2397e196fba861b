"""`orthocapture cancel` ends one computation of a run, with a reason and a name, and says what it cannot end."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from service.cli.main import app
from service.store.records import NewJob
from service.store.store import Store
from tests.support.record.store import enqueue, start_run


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(tmp_path / "data") as opened:
        yield opened


def cancel(store: Store, *words: str) -> Result:
    return CliRunner().invoke(app, ["cancel", *words, "--data", str(store.database_path.parent), "--operator", "Ada"])


def test_one_computation_is_ended_and_the_others_stay(store: Store) -> None:
    run = start_run(store)
    jobs = [enqueue(store, run, NewJob("fuse", "register", 1, f"key-{k}", {}), actor="runner") for k in range(2)]
    for words, wanted in (
        (["", "--reason", "it hangs"], "2 computations of the run begin with ''"),
        (["nothing", "--reason", "it hangs"], "no computation of the run is called 'nothing'"),
        ([jobs[0].job_id, "--reason", " "], "a reason is needed"),
    ):
        refused = cancel(store, *words)
        assert refused.exit_code != 0
        assert wanted in " ".join(refused.output.split())
    done = cancel(store, jobs[0].job_id, "--reason", "it hangs", "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout) == {"run": run, "cancelled": jobs[0].job_id, "event": store.head(run)}
    assert [job.state for job in store.jobs(run)] == ["failed", "queued"]
    assert store.events(run)[-1].actor == "Ada"
