"""The fill level of the spool: counted by the uploader, completed by whoever asks, and shown wherever people look."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from service.cli.main import app
from service.store.database.tables import copies
from service.store.objects.interface import ObjectStoreAwayError
from service.store.objects.opening import open_objects
from service.store.objects.s3 import S3Objects
from service.store.objects.spool import SpoolLevel, read_waiting, spool_level
from service.store.objects.upload import Uploader
from service.store.records import NewArtefact
from service.store.site import load_site
from service.store.store import Store
from tests.support.pages.web import web_site
from tests.support.processes.object_store import Weed
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import captured, start_run
from tests.support.runs.bench_run import PROTOCOL, begin_run, bench_store


def away(data: Path) -> S3Objects:
    """A site whose object store does not answer."""
    data.mkdir(exist_ok=True, parents=True)
    keys = data / "store_keys.yaml"
    keys.touch(mode=0o600)
    keys.write_text("{access_key_id: a, secret_access_key: s}")
    section = {"url": "s3://ready/site", "endpoint": "http://127.0.0.1:9", "keys": keys.name}
    (data / "site.yaml").write_text(yaml.safe_dump({"object_store": section}))
    site = load_site(data)
    assert site is not None
    assert site.object_store is not None
    return open_objects(data, site.object_store)


def capture(store: Store, run_id: str, viewpoint: str, content: bytes = b"") -> None:
    content = content or viewpoint.encode() * 1000
    ref = store.put_bytes(content, kind="image", media_type="image/jpeg", original_name=f"{viewpoint}.jpg")
    payload = captured(ref, viewpoint)
    store.record(run_id, [payload], actor="runner", artefacts=[NewArtefact(ref, "camera", "capture", 1, viewpoint)])


def level_of(store: Store) -> SpoolLevel:
    level = spool_level(store)
    assert level is not None
    return level


def require_exact(store: Store, place: str) -> int:
    """Compare the level with a count of everything. Returns the number of files that wait."""
    with store.database.reading() as connection:
        whole = read_waiting(connection, place)
    waiting = level_of(store).waiting
    assert waiting == whole
    return waiting.files


def test_the_level_is_that_of_a_whole_count_whatever_the_uploader_has_done(weed: Weed, tmp_path: Path) -> None:
    objects = weed.write_site(tmp_path / "data")
    with Store.open(tmp_path / "data") as store:
        run_id = start_run(store)
        recorded = require_exact(store, objects.place)
        for number in range(20):
            capture(store, run_id, f"v{number}")
        assert require_exact(store, objects.place) == recorded + 20
        asked: list[int] = []
        uploader = Uploader(store, objects)
        uploader.drain(lambda: asked.append(0) or len(asked) > 12)  # it is stopped in between
        assert 0 < require_exact(store, objects.place) < recorded + 20
        capture(store, run_id, "again", b"v19" * 1000)  # the same content, which waits already
        capture(store, run_id, "later")
        left = require_exact(store, objects.place)
        assert Uploader(store, objects).drain() == left, "another process goes on where the first one ended"
        assert require_exact(store, objects.place) == 0
        capture(store, run_id, "last")
        assert require_exact(store, objects.place) == 1
        with store.database.writing() as connection:
            connection.execute(copies.delete())
        assert require_exact(store, objects.place) == recorded + 22, "its rows are lost: everything is asked again"
        assert Uploader(store, objects).drain() == recorded + 22


def test_a_file_that_is_refused_waits_and_is_tried_again_by_the_next_uploader(weed: Weed, tmp_path: Path) -> None:
    objects = weed.write_site(tmp_path / "data")
    with Store.open(tmp_path / "data") as store:
        run_id = start_run(store)
        for number in range(4):
            capture(store, run_id, f"v{number}")
        sha256 = sorted(artefact.ref.sha256 for artefact in store.artefacts(run_id))[0]
        path = store.artefact_path(sha256)
        before = path.read_bytes()
        path.chmod(0o600)
        path.write_bytes(b"altered")
        Uploader(store, objects).drain()
        assert require_exact(store, objects.place) == 1
        path.write_bytes(before)
        assert Uploader(store, objects).drain() == 1
        assert require_exact(store, objects.place) == 0


def test_status_and_doctor_say_bytes_age_and_how_long_the_disk_lasts(tmp_path: Path) -> None:
    data = tmp_path / "data"
    objects = away(data)
    with bench_store(data) as store:
        run_id = start_run(store)
        begin_run(store, PROTOCOL, tmp_path)
        capture(store, run_id, "v1", b"x" * 3_000_000)
        with pytest.raises(ObjectStoreAwayError):
            Uploader(store, objects).drain()
        capture(store, run_id, "v2", b"y" * 4_000_000)
        level = level_of(store)
        assert level.waiting.size_bytes >= 7_000_000
        assert level.bytes_per_hour > 7_000_000
        assert level.lasts_hours is not None
        assert level.free_bytes > 0
        assert "GB are free on this disk" in level.sentence
        assert "which last 5.0 hours at" in replace(level, lasts_hours=5.0).sentence
    (tmp_path / "rig.yaml").write_text("name: bare\nsimulated: true\ndevices: {}\n")
    for arguments in (["status", "latest"], ["doctor", "--rig", str(tmp_path / "rig.yaml")]):
        said = " ".join(CliRunner().invoke(app, [*arguments, "--data", str(data)]).output.split())
        assert "wait for the object store since" in said
        assert "free on this disk" in said
    state = json.loads(CliRunner().invoke(app, ["status", "latest", "--json", "--data", str(data)]).output)
    assert state["object_store"]["waiting"]["size_bytes"] == level.waiting.size_bytes


def test_files_that_nobody_uploads_are_said_to_wait_for_an_uploader(tmp_path: Path) -> None:
    away(tmp_path / "data")
    clock = SteppedClock.from_now()
    with web_site(tmp_path, clock=clock) as web:
        other = start_run(web.site.store)
        run_id = web.begin_run(PROTOCOL).run_id
        capture(web.site.store, other, "v1")
        capture(web.site.store, other, "v2")
        assert level_of(web.site.store).trouble is None, "an uploader may just begin"
        technician = web.browser("technician")
        assert "wait for the object store since" in technician.get("/").text
        page = technician.get(f"/runs/{run_id}").text
        assert "Object store" in page
        assert "to send" in page
        clock.passed_s += 200
        assert "no uploader is at work" in technician.get("/").text
        assert "no uploader is at work" in technician.get(f"/runs/{run_id}").text
