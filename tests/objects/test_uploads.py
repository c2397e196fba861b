"""Uploads beside captures: what is recorded reaches the store, whatever befalls the store."""

from __future__ import annotations

import fcntl
import json
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from sqlalchemy import select
from typer.testing import CliRunner

from service.cli.main import app
from service.store.database.tables import copies
from service.store.objects.interface import ObjectStore, ObjectStoreAwayError, ObjectStoreError
from service.store.objects.spool import read_trouble, read_waiting
from service.store.objects.upload import Uploader
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.processes.object_store import Weed
from tests.support.processes.waiting import until
from tests.support.record.outsider import write_site_file
from tests.support.runs.bench_run import PROTOCOL, Bench, begin_run, bench_store


def finished(folder: Path) -> tuple[Store, Bench]:
    store = bench_store(folder / "data")
    bench = begin_run(store, PROTOCOL, folder)
    assert bench.run().terminal
    return store, bench


def recorded(store: Store, bench: Bench) -> set[str]:
    return {artefact.ref.sha256 for artefact in store.artefacts(bench.run_id)}


def confirmed(store: Store) -> set[str]:
    with store.database.reading() as connection:
        return set(connection.execute(select(copies.c.sha256)).scalars())


def test_every_recorded_file_is_confirmed_by_the_store(weed: Weed, tmp_path: Path) -> None:
    objects = weed.write_site(tmp_path / "data")
    store, bench = finished(tmp_path)
    with store:
        heads = store.head(bench.run_id)
        assert Uploader(store, objects).drain() == len(recorded(store, bench))
        assert confirmed(store) == recorded(store, bench) == {name for name, _size in objects.list()}
        assert Uploader(store, objects).drain() == 0
        assert store.head(bench.run_id) == heads, "nothing is recorded in the chain"
    assert verify(tmp_path / "data").ok


def test_a_store_of_which_the_rows_are_lost_is_asked_again(weed: Weed, tmp_path: Path) -> None:
    objects = weed.write_site(tmp_path / "data")
    store, bench = finished(tmp_path)
    with store:
        Uploader(store, objects).drain()
        with store.database.writing() as connection:
            connection.execute(copies.delete())
        assert Uploader(store, objects).drain() == len(recorded(store, bench))


def test_a_file_that_was_altered_or_that_the_store_holds_otherwise_is_not_confirmed(
    weed: Weed, tmp_path: Path
) -> None:
    objects = weed.write_site(tmp_path / "data")
    store, bench = finished(tmp_path)
    with store:
        altered, forged, *_ = sorted(recorded(store, bench))
        path = store.artefact_path(altered)
        path.chmod(0o600)
        path.write_bytes(b"x" * path.stat().st_size)
        assert objects.requests.send("PUT", objects.key(forged), body=b"forged").status == 200
        uploader = Uploader(store, objects)
        uploader.drain()
        assert set(uploader.refused) == {altered, forged}
        assert confirmed(store) == recorded(store, bench) - {altered, forged}


def test_a_bucket_that_is_not_there_is_not_made_by_an_upload(weed: Weed, tmp_path: Path) -> None:
    weed.write_site(tmp_path / "data")
    store, _bench = finished(tmp_path)
    with store:
        misspelt = weed.objects("raedy", "site")
        with pytest.raises(ObjectStoreError, match="no bucket 'raedy'"):
            Uploader(store, misspelt).drain()
        with pytest.raises(ObjectStoreError, match="no bucket"):
            misspelt.require_bucket()
        assert confirmed(store) == set()


class Interrupted:
    """A store that calls a function before each put."""

    def __init__(self, objects: ObjectStore, before_put: Callable[[int], None]) -> None:
        self._objects, self._before_put, self._puts = objects, before_put, 0
        self.require_bucket, self.stat, self.chunks = objects.require_bucket, objects.stat, objects.chunks
        self.fetch, self.list, self.delete = objects.fetch, objects.list, objects.delete

    @property
    def place(self) -> str:
        return self._objects.place

    def put_if_absent(self, sha256: str, path: Path) -> bool:
        self._before_put(self._puts)
        self._puts += 1
        return self._objects.put_if_absent(sha256, path)


@pytest.mark.slow
def test_a_server_that_is_killed_during_an_upload_loses_nothing_that_was_confirmed(tmp_path: Path) -> None:
    server = Weed(tmp_path / "server")
    server.start()
    try:
        objects = server.write_site(tmp_path / "data")
        store, bench = finished(tmp_path)
        with store:
            killed = Interrupted(objects, lambda puts: server.kill() if puts == 3 else None)
            with pytest.raises(ObjectStoreAwayError):
                Uploader(store, killed).drain()
            before = confirmed(store)
            assert 0 < len(before) < len(recorded(store, bench))
            server.start()
            Uploader(store, objects).drain()
            assert confirmed(store) == recorded(store, bench)
            for sha256 in before:
                objects.fetch(sha256, tmp_path / sha256)
    finally:
        server.kill()


@pytest.mark.slow
def test_captures_go_on_while_the_store_is_away_and_the_spool_drains_by_itself_afterwards(tmp_path: Path) -> None:
    server = Weed(tmp_path / "server")
    server.start()
    try:
        objects = server.write_site(tmp_path / "data")
        server.kill()
        store = bench_store(tmp_path / "data")
        bench = begin_run(store, PROTOCOL, tmp_path)
        process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "service.cli.main",
                "store",
                "upload",
                "--follow",
                "--data",
                str(tmp_path / "data"),
            ]
        )
        try:
            with store:
                assert bench.run().terminal
                assert confirmed(store) == set()
                until(lambda: read_trouble(tmp_path / "data") is not None, "the uploader did not come to it", 200)
                said = CliRunner().invoke(app, ["status", "latest", "--json", "--data", str(tmp_path / "data")])
                state = json.loads(said.output)["object_store"]
                assert state["waiting"]["files"] == len(recorded(store, bench))
                assert state["waiting"]["since_utc"]
                assert "does not answer" in state["trouble"]["what"]
                assert process.poll() is None
                server.start()
                until(lambda: confirmed(store) == recorded(store, bench), "the uploader did not come to it", 200)
                until(lambda: read_trouble(tmp_path / "data") is None, "the uploader did not come to it", 200)
                with store.database.reading() as connection:
                    assert read_waiting(connection, objects.place).files == 0
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(60)
    finally:
        server.kill()


@pytest.mark.slow
def test_a_worker_uploads_beside_its_jobs_and_ends_its_uploader(weed: Weed, tmp_path: Path) -> None:
    weed.write_site(tmp_path / "data")
    store, bench = finished(tmp_path)
    with store:
        command = [sys.executable, "-m", "service.cli.main", "worker", "--data", str(tmp_path / "data")]
        process = subprocess.Popen(command)
        try:
            until(lambda: confirmed(store) == recorded(store, bench), "the uploader did not come to it", 200)
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(60)
        with (tmp_path / "data" / "monitor" / "upload.lock").open() as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # nobody holds it any more


def test_the_command_says_what_waits_and_why(weed: Weed, tmp_path: Path) -> None:
    weed.write_site(tmp_path / "data")
    store, bench = finished(tmp_path)
    with store:
        done = CliRunner().invoke(app, ["store", "upload", "--json", "--data", str(tmp_path / "data")])
        assert done.exit_code == 0, done.output
        assert json.loads(done.output)["confirmed"] == len(recorded(store, bench))
    write_site_file(tmp_path / "data", {})
    refused = CliRunner().invoke(app, ["store", "upload", "--data", str(tmp_path / "data")])
    assert refused.exit_code == 1
    assert "names no object store" in refused.output
