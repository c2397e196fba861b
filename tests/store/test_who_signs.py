"""Of the data folders that share a site's database one signs; the others work without a key, and say who does."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.core.records.events import SignerNamed
from service.core.records.run_events import StepNote
from service.rig import load_rig
from service.run_start import require_rig_free
from service.store.records import SITE, NewJob, SignsElsewhereError
from service.store.signatures.signing import checkpoint, checkpoint_here, rotate_key
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.processes.postgres import Cluster
from tests.support.record.store import capture, enqueue, start_run

pytestmark = [
    pytest.mark.packages("postgresql"),
    pytest.mark.timeout(300),
    pytest.mark.sqlite("shares the database of a server by itself"),
]
NOTE = StepNote(step="s", attempt=1, note="n")


@pytest.fixture
def folders(cluster: Cluster, tmp_path: Path) -> tuple[Path, Path]:
    """The folder that signs, with a run, and another one of the same site that has the files."""
    database = cluster.new_database()
    first, second = (cluster.site(tmp_path / name, database) for name in ("first", "second"))
    with Store.open(first) as store:
        run_id = start_run(store)
        capture(store, run_id, "v1")
        enqueue(store, run_id, NewJob("detect", "capture", 1, "a", {}), actor="runner")
        checkpoint(store, run_id)
    with Store.open(second):
        shutil.copytree(first / "artefacts", second / "artefacts", dirs_exist_ok=True)
    return first, second


def signers(store: Store) -> list[str]:
    return [e.payload.folder for e in store.events(SITE) if isinstance(e.payload, SignerNamed)]


def sign_here(folder: Path) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["audit", "sign-here", "--data", str(folder), "--operator", "Ada"])
    return done.exit_code, " ".join(done.output.split())


def test_another_folder_works_without_a_key_and_says_who_signs(folders: tuple[Path, Path], tmp_path: Path) -> None:
    first, second = folders
    (tmp_path / "rig.yaml").write_text("name: rig\nsimulated: true\ndevices: {}\n")
    with Store.open(second) as store:
        run_id = store.find_run("latest")
        job = store.claim_job("worker elsewhere", 60.0)
        assert job is not None
        store.finish_job(job, measures={}, duration_s=1.0)
        assert checkpoint_here(store, run_id) is None
        for act in (
            lambda: checkpoint(store, run_id),
            lambda: rotate_key(store, reason="yearly", actor="Ada"),
            lambda: require_rig_free(store, load_rig(tmp_path / "rig.yaml").path),
        ):
            with pytest.raises(SignsElsewhereError, match=f"another data folder signs this site: {first} on "):
                act()
        assert signers(store) == [str(first)]
    assert not (second / "keys").exists()
    report = verify(second)
    assert report.ok, report.faults
    assert any(f"the log of signatures is in {first} on " in note for note in report.notes)
    with Store.open(first) as store:
        assert checkpoint_here(store, run_id) is not None, "what the other did is signed here"
    for folder in folders:
        report = verify(folder)
        assert (report.ok, report.unsigned_events[run_id]) == (True, 0), report.faults


def test_a_log_that_was_removed_where_it_belongs_is_a_fault(folders: tuple[Path, Path]) -> None:
    first, _ = folders
    (first / "signatures.jsonl").unlink()
    (first / "signer").unlink()
    assert not verify(first).ok


def test_signing_is_handed_over_with_key_and_log(folders: tuple[Path, Path]) -> None:
    first, second = folders
    status, said = sign_here(second)
    assert (status, "the log of signatures is missing" in said) == (1, True), said
    shutil.copy(first / "signatures.jsonl", second)
    status, said = sign_here(second)
    assert (status, "the signing key is missing" in said) == (1, True), said
    shutil.copytree(first / "keys", second / "keys")
    with Store.open(first) as store:  # meanwhile it signs once more
        run_id = store.find_run("latest")
        store.record(run_id, [NOTE], actor="Ada")
        checkpoint(store, run_id)
    status, said = sign_here(second)
    assert (status, "the log of signatures here misses 2 of them" in said) == (1, True), said
    shutil.copy(first / "signatures.jsonl", second)
    status, said = sign_here(second)
    assert (status, "This folder signs the site from now on" in said) == (0, True), said
    with Store.open(first) as store, pytest.raises(SignsElsewhereError, match=str(second)):
        checkpoint(store, run_id)
    with Store.open(second) as store:
        store.record(run_id, [NOTE], actor="Ada")
        checkpoint(store, run_id)
        assert signers(store) == [str(first), str(second)]
    assert verify(second).ok
