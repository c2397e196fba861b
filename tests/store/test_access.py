"""Who may read what is made: its owner alone, under any umask, or a group with which the owner shares it."""

from __future__ import annotations

import logging
import os
import stat
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.core.errors import StoreError
from service.core.records.events import LeftoversRemoved
from service.people.sessions import People
from service.store.backup import BackupOptions, back_up
from service.store.database.engine import database_path, open_read_only
from service.store.durable_effects import DurableFiles
from service.store.records import SITE, SigningKeyError
from service.store.restoring import restore
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.web import QUICK_HASHES, populate, web_site
from tests.support.record.stepped_clock import SteppedClock

GROUP = os.getegid() + 1 if os.geteuid() == 0 else os.getegid()


@pytest.fixture(autouse=True)
def _usual_umask() -> Generator[None]:
    before = os.umask(0o022)
    yield
    os.umask(before)


def open_to_others(folder: Path) -> list[str]:
    """What somebody else may read, write or enter."""
    paths = [folder, *folder.rglob("*")]
    return [str(path.relative_to(folder)) for path in paths if path.lstat().st_mode & 0o077]


@contextmanager
def another_account(folder: Path) -> Generator[None]:
    """As another account: by another user's rights, or, for whoever cannot take those, without any."""
    if os.geteuid() == 0:
        os.seteuid(65534)
        try:
            yield
        finally:
            os.seteuid(0)
        return
    folder.chmod(0)
    try:
        yield
    finally:
        folder.chmod(0o700)


@contextmanager
def another_account_of_the_group() -> Generator[None]:
    """As another account that belongs to GROUP; as oneself for whoever cannot become another."""
    if os.geteuid() != 0:
        yield
        return
    before = os.getegid()
    os.setegid(GROUP)
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)
        os.setegid(before)


@pytest.mark.sqlite("backups and journal: a server has its own")
def test_whatever_is_made_is_its_owners_alone(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    with web_site(tmp_path, clock=SteppedClock()) as site:
        site.record_run()
        checkpoint(site.store, SITE)
        assert database_path(site.site.data).with_name("orthocapture.sqlite-wal").exists()
        assert open_to_others(site.site.data) == []
        data = site.site.data
    for options in (BackupOptions(), BackupOptions(with_keys=True)):
        back_up(data, tmp_path / "backup", options)
        assert open_to_others(tmp_path / "backup") == []
    report = restore(tmp_path / "backup", tmp_path / "again", actor=lambda _: "ada")
    assert report.ok
    assert open_to_others(tmp_path / "again") == []


def test_what_commands_leave_beside_the_record_is_its_owners_too(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with Store.open(data) as store:
        store.record_site([], actor="ada")
        checkpoint(store, SITE)
    for command in (["audit", "verify", "all"], ["worker", "--until-idle"]):
        result = CliRunner().invoke(app, [*command, "--data", str(data)], catch_exceptions=False)
        assert result.exit_code == 0, result.output
    assert list((data / "monitor").iterdir())
    assert open_to_others(data) == []
    assert stat.S_IMODE((tmp_path / "data").stat().st_mode) == 0o700


def test_a_folder_of_an_earlier_version_is_closed_and_the_log_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = tmp_path / "data"
    with Store.open(data) as store:
        store.record_site([], actor="ada")
        checkpoint(store, SITE)
    for path in (data, *data.rglob("*")):
        path.chmod(0o755 if path.is_dir() else 0o444 if "artefacts" in path.parts else 0o644)
    with caplog.at_level(logging.WARNING), Store.open(data):
        assert open_to_others(data) == []
    (told,) = [record.message for record in caplog.records if "service.store.data_folder" in record.name]
    assert "for its owner alone now" in told
    assert "other accounts of this machine could read it" in told
    assert verify(data).ok
    caplog.clear()
    with Store.open(data):
        assert not caplog.records


@pytest.mark.slow
def test_opening_again_in_one_process_keeps_the_locks_that_keep_the_log_from_others(tmp_path: Path) -> None:
    """POSIX releases a process's locks when it closes any descriptor of the file, and the log would be removed."""
    data = tmp_path / "data"
    with Store.open(data) as store:
        store.record_site([], actor="ada")
        Store.open(data).close()
        listed = [sys.executable, "-m", "service.cli.main", "runs", "--data", str(data)]
        assert subprocess.run(listed, check=False, capture_output=True).returncode == 0
        store.record_site([], actor="ada")


def test_a_folder_that_was_made_by_hand_is_closed_when_it_becomes_a_data_folder(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir(mode=0o755)
    with Store.open(tmp_path / "data"):
        assert open_to_others(tmp_path / "data") == []


def test_a_folder_that_is_everybodys_is_no_data_folder(tmp_path: Path) -> None:
    tmp_path.chmod(0o1777)
    with pytest.raises(StoreError, match="everybody"):
        Store.open(tmp_path)
    assert tmp_path.stat().st_mode & 0o7777 == 0o1777


def test_a_folder_shared_with_a_group_stays_shared_but_for_the_keys(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = tmp_path / "data"
    with Store.open(data) as store:
        populate(People(store, QUICK_HASHES))
        checkpoint(store, SITE)
    os.chown(data, -1, GROUP)
    data.chmod(0o2770)
    with caplog.at_level(logging.WARNING), Store.open(data) as store:
        store.put_bytes(b"x", kind="image", media_type="image/jpeg", original_name="x")
        for path in data.rglob("*"):
            mode, group = path.stat().st_mode, path.stat().st_gid
            if "keys" in path.parts:
                assert mode & 0o077 == 0, path
            else:
                assert (mode & 0o007, group) == (0, GROUP), path
                assert mode & 0o070 >= (0o070 if path.is_dir() else 0o040), path
    assert any(f"the group {GROUP}" in record.message for record in caplog.records)
    data.chmod(0o2775)
    with Store.open(data):
        assert data.stat().st_mode & 0o7777 == 0o2770


def test_an_account_of_the_group_records_and_does_not_sign() -> None:
    with TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        data = Path(folder) / "data"
        with Store.open(data) as store:
            store.record_site([], actor="ada")
            checkpoint(store, SITE)
        os.chown(data, -1, GROUP)
        data.chmod(0o2770)
        Store.open(data).close()
        with another_account_of_the_group(), Store.open(data) as store:
            store.put_bytes(b"computed", kind="image", media_type="image/jpeg", original_name="x")
            store.record_site([LeftoversRemoved(files={"x": 1})], actor="ada")
            if os.geteuid() != 0 and os.getuid() == 0:
                with pytest.raises(SigningKeyError, match="another account's"):
                    checkpoint(store, SITE)
        with Store.open(data) as store:
            checkpoint(store, SITE)
            assert store.put_bytes(b"computed", kind="image", media_type="image/jpeg", original_name="x")
        assert verify(data).ok


def test_another_account_is_told_whose_the_folder_is(tmp_path: Path) -> None:
    data = tmp_path / "data"
    Store.open(data).close()
    with another_account(data):
        for command in (lambda: Store.open(data, create=False), lambda: open_read_only(data, DurableFiles())):
            with pytest.raises(StoreError, match="only for the account"):
                command()
        told = CliRunner().invoke(app, ["status", "--data", str(data)])
    assert told.exit_code == 1
    assert "chmod 2770" in told.stderr
