"""The adapter to an object store, against a real server: what evidence relies on, and what a probe finds."""

from __future__ import annotations

import hashlib
import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.core.errors import IntegrityError
from service.store.durable_effects import SystemClock
from service.store.objects.interface import ObjectStoreAwayError, ObjectStoreError
from service.store.objects.opening import probe
from service.store.objects.s3 import StoreKeys
from tests.support.processes.object_store import Weed


def written(folder: Path, content: bytes) -> tuple[str, Path]:
    sha256 = hashlib.sha256(content).hexdigest()
    (folder / sha256).write_bytes(content)
    return sha256, folder / sha256


@pytest.mark.parametrize("size", [0, 1, 7_000_000], ids=["empty", "one byte", "above the size of a part"])
def test_what_is_put_is_stated_listed_fetched_and_deleted(weed: Weed, tmp_path: Path, size: int) -> None:
    objects = weed.new_objects()
    sha256, path = written(tmp_path, b"x" * size)
    assert objects.stat(sha256) is None
    assert objects.put_if_absent(sha256, path)
    assert not objects.put_if_absent(sha256, path)
    stated = objects.stat(sha256)
    assert stated is not None
    assert (stated.size_bytes, stated.sha256) == (size, sha256)
    assert list(objects.list()) == [(sha256, size)]
    assert objects.fetch(sha256, tmp_path / "back") == size
    assert (tmp_path / "back").read_bytes() == path.read_bytes()
    objects.delete(sha256)
    assert objects.stat(sha256) is None
    with pytest.raises(ObjectStoreError, match="no such object"):
        objects.fetch(sha256, tmp_path / "again")
    assert not (tmp_path / "again").exists()


def test_of_racing_puts_one_stores_the_object(weed: Weed, tmp_path: Path) -> None:
    objects = weed.new_objects()
    for number in range(5):
        sha256, path = written(tmp_path, b"raced for %d" % number * 10_000)
        with ThreadPoolExecutor(8) as pool:
            stored = list(pool.map(lambda _, s=sha256, p=path: objects.put_if_absent(s, p), range(8)))
        assert stored.count(True) == 1


def test_a_file_that_is_not_what_its_name_says_never_leaves(weed: Weed, tmp_path: Path) -> None:
    objects = weed.new_objects()
    sha256, path = written(tmp_path, b"as captured")
    path.write_bytes(b"as altered!")
    with pytest.raises(IntegrityError, match="altered"):
        objects.put_if_absent(sha256, path)
    assert objects.stat(sha256) is None


def test_other_content_in_the_store_is_refused_on_fetch_and_not_overwritten(weed: Weed, tmp_path: Path) -> None:
    objects = weed.new_objects()
    sha256, path = written(tmp_path, b"as captured")
    assert objects.requests.send("PUT", objects.key(sha256), body=b"forged").status == 200
    with pytest.raises(IntegrityError, match="other content"):
        objects.fetch(sha256, tmp_path / "back")
    assert not (tmp_path / "back").exists()
    assert not objects.put_if_absent(sha256, path)
    stated = objects.stat(sha256)
    assert stated is not None
    assert stated.sha256 != sha256


def test_wrong_keys_are_refused_and_a_server_that_is_gone_is_away(tmp_path: Path, weed: Weed) -> None:
    sha256, path = written(tmp_path, b"as captured")
    stranger = weed.objects("ready", keys=StoreKeys("stranger", "wrong"))
    for attempt in (lambda: stranger.put_if_absent(sha256, path), lambda: stranger.stat(sha256)):
        with pytest.raises(ObjectStoreError) as refused:
            attempt()
        assert not isinstance(refused.value, ObjectStoreAwayError)
        assert "wrong" not in str(refused.value)
    gone = Weed(tmp_path / "gone").objects("ready")  # never started
    for attempt in (lambda: gone.put_if_absent(sha256, path), lambda: gone.stat(sha256)):
        with pytest.raises(ObjectStoreAwayError):
            attempt()


def test_a_probe_finds_a_sound_store_sound_and_one_without_locks_not(weed: Weed) -> None:
    sound = probe(weed.new_objects(lock=True), SystemClock(), lock_days=1)
    assert [result.name for result in sound if result.problem] == []
    assert sound[-1].name == "a locked object cannot be deleted"
    unlocked = probe(weed.new_objects(), SystemClock(), lock_days=1)
    assert [result.name for result in unlocked if result.problem] == ["a locked object cannot be deleted"]
    refused = probe(weed.objects("ready", keys=StoreKeys("stranger", "wrong")), SystemClock())
    assert [bool(result.problem) for result in refused] == [True]


def test_the_doctor_names_what_it_tried_and_what_failed(weed: Weed, tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text("name: bare\nsimulated: true\ndevices: {}\n")
    data = tmp_path / "data"
    weed.write_site(data)
    arguments = ["doctor", "--rig", str(tmp_path / "rig.yaml"), "--data", str(data), "--json"]
    sound = json.loads(CliRunner().invoke(app, arguments, catch_exceptions=False).output)
    assert set(sound["object_store"].values()) == {"ok"}
    assert "a second put of other bytes loses" in sound["object_store"]
    (data / "store_keys.yaml").write_text("{access_key_id: stranger, secret_access_key: wrong}")
    refused = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert refused.exit_code == 1
    assert "refused" in json.loads(refused.output)["object_store"]["the bucket exists"]


def test_the_doctor_refuses_a_misspelt_bucket_by_name_and_makes_none(weed: Weed, tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text("name: bare\nsimulated: true\ndevices: {}\n")
    data = tmp_path / "data"
    weed.write_site(data)
    (data / "site.yaml").write_text((data / "site.yaml").read_text().replace("s3://ready/", "s3://redy/"))
    arguments = ["doctor", "--rig", str(tmp_path / "rig.yaml"), "--data", str(data), "--json"]
    for _ in range(2):  # the keys of the tests may do everything: a put would make it
        refused = CliRunner().invoke(app, arguments, catch_exceptions=False)
        assert refused.exit_code == 1
        assert json.loads(refused.output)["object_store"] == {
            "the bucket exists": "the object store has no bucket 'redy'"
        }
