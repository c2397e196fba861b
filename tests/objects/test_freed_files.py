"""Files that were freed from the spool: what may be freed, how they are read again, and what verifies them."""

from __future__ import annotations

import json
import os
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from service.audit.recorded_run import RecordedFiles
from service.cli.main import app
from service.core.errors import IntegrityError
from service.store.backup import back_up
from service.store.objects.s3 import S3Objects
from service.store.objects.spool import free_spool, spool_files
from service.store.objects.upload import Uploader
from service.store.restoring import rebuild, restore
from service.store.site import SpoolSection
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.processes.object_store import Weed
from tests.support.runs.bench_run import PROTOCOL, Bench, begin_run, bench_store

VERIFY = ["audit", "verify", "all", "--stated-hashes", "--json", "--data"]
AT_ONCE = SpoolSection(free_after_days=0)


def uploaded(weed: Weed, folder: Path, cache_gb: float = 20.0) -> tuple[Store, Bench, S3Objects]:
    """A run that has ended, all of whose files the object store has confirmed."""
    objects = weed.write_site(folder / "data", free_after_days=0, cache_gb=cache_gb)
    store = bench_store(folder / "data")
    bench = begin_run(store, PROTOCOL, folder)
    assert bench.run().terminal
    Uploader(store, objects).drain()
    return store, bench, objects


def in_spool(store: Store, sha256: str) -> Path:
    return store.artefact_folder / sha256[:2] / sha256


def images(store: Store, bench: Bench) -> list[str]:
    return sorted({artefact.ref.sha256 for artefact in store.artefacts(bench.run_id)})


def test_a_freed_file_is_read_again_and_verified_by_several_readers_at_once(weed: Weed, tmp_path: Path) -> None:
    store, bench, objects = uploaded(weed, tmp_path)
    with store:
        before = {sha256: store.artefact_path(sha256).read_bytes() for sha256 in images(store, bench)}
        freed = [file for file in free_spool(store, objects, AT_ONCE) if not file.stays]
        assert {file.sha256 for file in freed} == set(before)
        assert not any(in_spool(store, sha256).exists() for sha256 in before)
        with ThreadPoolExecutor(8) as pool:  # several readers at once
            read = list(pool.map(lambda sha256: store.artefact_path(sha256).read_bytes(), [*before] * 4))
        assert read == [*before.values()] * 4
        for sha256, content in before.items():
            assert store.artefact_path(sha256, verify=True).read_bytes() == content
            assert RecordedFiles(tmp_path / "data").artefact_path(sha256).read_bytes() == content
        first = next(iter(before))
        cached = store.artefact_path(first)
        cached.chmod(0o600)
        cached.write_bytes(b"altered in the cache")
        assert store.artefact_path(first, verify=True).read_bytes() == before[first]
        again, _size = store._folder.put([before[first]])  # pyright: ignore[reportPrivateUsage]
        assert again == first
        assert in_spool(store, first).is_file()


def test_what_the_store_holds_otherwise_or_not_at_all_is_refused(weed: Weed, tmp_path: Path) -> None:
    store, bench, objects = uploaded(weed, tmp_path)
    with store:
        altered, deleted, away, *_ = images(store, bench)
        free_spool(store, objects, AT_ONCE)
        assert objects.requests.send("PUT", objects.key(altered), body=b"forged").status == 200
        objects.delete(deleted)
        with pytest.raises(IntegrityError, match=r"missing, and|other content"):
            store.artefact_path(altered)
        with pytest.raises(IntegrityError, match="missing, and the object store has no such object"):
            store.artefact_path(deleted)
        found = verify(tmp_path / "data")
        assert {altered, deleted} == {name for name in (altered, deleted) if name in str(found.faults)}
        assert any("in the object store" in fault.what and deleted in fault.file for fault in found.faults)
        site = yaml.safe_load((tmp_path / "data" / "site.yaml").read_text())
        site["object_store"]["endpoint"] = "http://127.0.0.1:9"  # nobody listens there
        (tmp_path / "data" / "site.yaml").write_text(yaml.safe_dump(site))
    with Store.open(tmp_path / "data") as store, pytest.raises(IntegrityError, match="does not answer"):
        store.artefact_path(away)
    unread = verify(tmp_path / "data")
    assert unread.ok, "nobody can say that they are missing"
    assert not unread.verified
    assert "files are not here and are not compared, because their object store is away" in unread.not_compared[0]
    said = CliRunner().invoke(app, ["audit", "verify", "all", "--data", str(tmp_path / "data")])
    assert said.exit_code == 1
    assert "NOT verified as a whole" in said.output


def test_only_what_is_confirmed_old_and_of_ended_runs_is_freed(weed: Weed, tmp_path: Path) -> None:
    objects = weed.write_site(tmp_path / "data")
    with bench_store(tmp_path / "data") as store:
        ended = begin_run(store, PROTOCOL, tmp_path)
        assert ended.run().terminal
        open_run = begin_run(store, PROTOCOL.replace("A small", "Another small"), tmp_path)
        mine = set(images(store, ended)) - set(images(store, open_run))

        def reasons(spool: SpoolSection) -> set[str]:
            return {file.stays for file in free_spool(store, objects, spool) if file.sha256 in mine}

        assert reasons(AT_ONCE) == {"the object store has not confirmed it"}
        Uploader(store, objects).drain()
        assert reasons(SpoolSection(free_after_days=1)) == {"it is younger than 1 days"}
        lost, *_ = sorted(mine)
        objects.delete(lost)
        stays = {file.sha256: file.stays for file in free_spool(store, objects, AT_ONCE)}
        assert stays.pop(lost) == "the object store does not state its hash any more"
        assert in_spool(store, lost).is_file()
        assert {sha256 for sha256, why in stays.items() if not why} == mine - {lost}
        assert {why for why in stays.values() if why} == {"its run has not ended"}
        assert all(in_spool(store, sha256).is_file() for sha256 in images(store, open_run))


def test_the_cache_forgets_what_was_not_used_for_longest(weed: Weed, tmp_path: Path) -> None:
    store, bench, objects = uploaded(weed, tmp_path, cache_gb=1e-9)
    with store:
        first, second, *_ = images(store, bench)
        free_spool(store, objects, AT_ONCE)
        unused = store.artefact_path(first)
        store.artefact_path(second)
        assert unused.exists(), "it was used just now"
        os.utime(unused, (1, 1))
        third = images(store, bench)[2]
        store.artefact_path(third)
        assert not unused.exists()
        assert store.artefact_path(first).exists(), "it is fetched again"


def test_the_audit_counts_how_freed_files_were_checked(weed: Weed, tmp_path: Path) -> None:
    store, bench, objects = uploaded(weed, tmp_path)
    with store:
        count = len(images(store, bench))
        here = verify(tmp_path / "data")
        assert here.ok
        assert not any("object store" in note for note in here.notes)
        free_spool(store, objects, AT_ONCE)
    fetched = verify(tmp_path / "data")
    assert fetched.ok
    assert (fetched.files, fetched.bytes_hashed) == (here.files, here.bytes_hashed)
    assert any(
        note.startswith(f"{count} of {count} files") and "fetched and hashed" in note for note in fetched.notes
    )
    said = CliRunner().invoke(
        app, ["audit", "verify", "all", "--stated-hashes", "--json", "--data", str(tmp_path / "data")]
    )
    assert said.exit_code == 0, said.output
    stated = json.loads(said.output)
    assert stated["bytes_hashed"] == 0
    assert any("NOT read" in note for note in stated["notes"])


def test_a_bundle_holds_freed_files(weed: Weed, tmp_path: Path) -> None:
    store, bench, objects = uploaded(weed, tmp_path)
    with store:
        names = images(store, bench)
        free_spool(store, objects, AT_ONCE)
    arguments = ["audit", "export", "latest", str(tmp_path / "bundle.zip"), "--data", str(tmp_path / "data")]
    made = CliRunner().invoke(app, arguments)
    assert made.exit_code == 0, made.output
    (written,) = tmp_path.glob("bundle*.zip")
    with zipfile.ZipFile(written) as bundle:
        held = {Path(name).name for name in bundle.namelist()}
    assert set(names) <= held


@pytest.mark.sqlite("backups and journal: a server has its own")
def test_a_backup_holds_freed_files(weed: Weed, tmp_path: Path) -> None:
    store, bench, objects = uploaded(weed, tmp_path)
    with store:
        names = images(store, bench)
        free_spool(store, objects, AT_ONCE)
    assert not back_up(tmp_path / "data", tmp_path / "backup").state.faults
    restored = restore(tmp_path / "backup", tmp_path / "restored", actor=lambda _folder: "Ada")
    assert restored.ok, restored.audit.faults
    assert all((tmp_path / "restored" / "artefacts" / name[:2] / name).is_file() for name in names)


def test_the_command_lists_and_frees(weed: Weed, tmp_path: Path) -> None:
    store, bench, objects = uploaded(weed, tmp_path)
    with store:
        names = images(store, bench)
        arguments = ["store", "gc", "--spool", "--json", "--data", str(tmp_path / "data")]
        listed = json.loads(CliRunner().invoke(app, arguments).output)
        assert len(listed["may_be_freed"]) == len(names)
        assert all(in_spool(store, name).is_file() for name in names)
        freed = json.loads(CliRunner().invoke(app, [*arguments, "--remove"]).output)
        assert len(freed["freed"]) == len(names)
        assert not any(in_spool(store, name).exists() for name in names)
        assert spool_files(store, objects.place, AT_ONCE) == []


def test_without_a_site_file_nothing_is_asked(tmp_path: Path) -> None:
    with bench_store(tmp_path / "data") as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        bench.run()
        name = images(store, bench)[0]
        in_spool(store, name).unlink()
        with pytest.raises(IntegrityError, match=r"^a stored file is missing \["):
            store.artefact_path(name)
    assert not (tmp_path / "data" / "fetched").exists()
    assert any(fault.what.startswith("the file is missing (") for fault in verify(tmp_path / "data").faults)


@pytest.mark.sqlite("backups and journal: a server has its own")
def test_a_rebuilt_database_misses_no_freed_file_and_the_store_is_asked_again(weed: Weed, tmp_path: Path) -> None:
    store, bench, objects = uploaded(weed, tmp_path)
    with store:
        names = images(store, bench)
        free_spool(store, objects, AT_ONCE)
    for part in (tmp_path / "data").glob("orthocapture.sqlite*"):
        part.unlink()
    made = rebuild(tmp_path / "data", actor=lambda _folder: "Ada")
    assert made.made
    assert made.lost == ()
    with Store.open(tmp_path / "data") as store:
        assert Uploader(store, objects).drain() == len(names)
        assert store.artefact_path(names[0], verify=True).is_file()
