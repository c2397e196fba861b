"""A site's database is restored to a moment from base backup and archive; the verification says what is lost."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Generator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from service.cli.main import app
from service.core.records.run_events import StepNote
from service.store.records import SITE
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from tests.support.processes.postgres import OTHER, Cluster
from tests.support.processes.waiting import until
from tests.support.record.store import capture, start_run
from tests.support.rig.rig import REPOSITORY

pytestmark = [pytest.mark.packages("postgresql"), pytest.mark.timeout(300)]
DEPLOY = REPOSITORY / "docs" / "deploy"
DATABASE, OWNER, ROLE = "orthocapture", "orthocapture_owner", "orthocapture"  # as DEPLOY has them


def settings(arguments: Sequence[str]) -> dict[str, str]:
    """The settings in `postgres -c NAME=VALUE …`."""
    return dict(word.split("=", 1) for before, word in pairwise(arguments) if before == "-c")


@pytest.fixture
def archived(tmp_path: Path) -> Generator[Cluster]:
    """A server that archives, and has roles and a database, as docs/deploy makes them."""
    compose: dict[str, Any] = yaml.safe_load((DEPLOY / "compose.yaml").read_text(encoding="utf-8"))
    cluster = Cluster()
    cluster.configure(settings(compose["services"]["database"]["command"]))
    cluster.start()
    subprocess.run([DEPLOY / "make_secrets.sh", tmp_path / "secrets"], check=True)
    server = {"PGHOST": cluster.host, "POSTGRES_USER": OTHER, "SECRETS": str(tmp_path / "secrets")}
    subprocess.run([DEPLOY / "roles.sh"], check=True, env={**os.environ, **server})
    prepared = CliRunner().invoke(app, ["store", "prepare", cluster.url(DATABASE, OWNER), "--role", ROLE])
    assert prepared.exit_code == 0, prepared.output
    yield cluster
    cluster.stop()


def write_site(folder: Path, cluster: Cluster) -> None:
    (folder / "site.yaml").write_text(yaml.safe_dump({"database": cluster.url(DATABASE, ROLE)}), encoding="utf-8")


def note(site: Path, text: str) -> None:
    with Store.open(site) as store:
        run_id = store.find_run("latest")
        store.record(run_id, [StepNote(step="capture", attempt=1, note=text)], actor="Ada")
        checkpoint(store, run_id)
        checkpoint(store, SITE)


def verified(site: Path) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["audit", "verify", "all", "--data", str(site)], env={"COLUMNS": "300"})
    return done.exit_code, done.output


@pytest.mark.slow
def test_a_site_is_restored_to_a_moment(archived: Cluster, tmp_path: Path) -> None:
    site = tmp_path / "site"
    site.mkdir(mode=0o700)
    write_site(site, archived)
    with Store.open(site) as store:
        capture(store, start_run(store), "v1_001")
    base = archived.base_backup()
    note(site, "after the base backup")
    folder_then = Path(shutil.copytree(site, tmp_path / "folder-then"))
    ((moment,),) = archived.run(DATABASE, "SELECT now()::text")
    note(site, "what a restoration to the moment does not have")
    archived.run(DATABASE, "SELECT pg_switch_wal()")
    until(lambda: len(list(archived.archive.glob("0*"))) >= 2, "the log is not archived")
    status, said = verified(site)
    assert status == 0, said
    archived.kill()

    restored = Cluster(base=base)
    restored.configure(
        {
            "restore_command": f"cp {archived.archive}/%f %p",
            "recovery_target_time": str(moment),
            "recovery_target_action": "promote",
        }
    )
    restored.start()
    try:
        until(lambda: restored.run(DATABASE, "SELECT pg_is_in_recovery()") == [(False,)], "it is not promoted")
        for folder in (site, folder_then):
            write_site(folder, restored)
        status, said = verified(site)
        assert status == 1
        assert "is no longer here: what it signed was removed" in said, "the folder of today knows what is lost"
        status, said = verified(folder_then)
        assert status == 0, said
        with Store.open(folder_then) as store:
            events = store.events(store.find_run("latest"))
            notes = [event.payload.note for event in events if isinstance(event.payload, StepNote)]
        assert notes == ["after the base backup"]
        note(folder_then, "the site goes on")
        status, said = verified(folder_then)
        assert status == 0, said
    finally:
        restored.stop()
        archived.start()
