"""A data folder on a file system that machines share, or without working locks, is refused before it is written."""

from __future__ import annotations

import errno
import fcntl
import json
import os
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.core.errors import StoreError
from service.store import data_folder
from service.store.store import Store
from tests.support.rig.rig import orthocapture


def table(folder: Path, kind: str, at: Path) -> Path:
    """A table of mounts as Linux writes it, in which `at` is of this kind."""
    point = str(at).replace(" ", "\\040")
    lines = [
        "22 1 0:20 / / rw,relatime shared:1 - ext4 /dev/vda rw",
        f"90 22 0:55 / {point} rw,relatime shared:40 master:1 - {kind} server:/export rw,vers=4.2",
    ]
    path = folder / "mountinfo"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("kind", ["nfs4", "nfs", "cifs", "smb3", "fuse.sshfs", "lustre", "ceph", "vboxsf"])
def test_a_folder_that_other_machines_can_mount_is_refused_for_writing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    share = tmp_path / "a share"
    share.mkdir()
    monkeypatch.setattr(data_folder, "MOUNT_TABLE", table(tmp_path, kind, share))
    with pytest.raises(StoreError, match=rf"other machines can mount too \({kind}\)") as refused:
        Store.open(share / "runs")
    assert "--allow-mount" in str(refused.value)
    assert not (share / "runs" / "orthocapture.sqlite").exists()
    with Store.open(tmp_path / "a shared disk beside it"):
        pass


@pytest.mark.parametrize("kind", ["ext4", "overlay", "xfs", "btrfs", "fuse.gocryptfs", "tmpfs", "zfs", "virtiofs"])
def test_local_disks_encrypted_ones_and_containers_pass(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setattr(data_folder, "MOUNT_TABLE", table(tmp_path, kind, tmp_path))
    with Store.open(tmp_path / "runs"):
        pass


def test_without_a_table_of_mounts_the_probe_decides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(data_folder, "MOUNT_TABLE", tmp_path / "there is none")
    with Store.open(tmp_path / "runs"):
        pass
    assert data_folder.file_system(tmp_path) == ""


@pytest.mark.parametrize(
    ("answer", "refusal"),
    [
        (OSError(errno.ENOLCK, "No locks available"), r"without working locks \(No locks available\)"),
        (None, "whose locks do not exclude anybody"),
    ],
)
def test_a_file_system_whose_locks_fail_or_exclude_nobody_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: OSError | None, refusal: str
) -> None:
    def lock(_descriptor: int, _command: int, _argument: Any = 0) -> int:
        if answer is not None:
            raise answer
        return 0

    monkeypatch.setattr(fcntl, "fcntl", lock)
    with pytest.raises(StoreError, match=refusal):
        data_folder.require_own_mount(tmp_path)


@pytest.mark.slow
def test_who_knows_better_allows_it_for_a_command_and_what_it_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(data_folder, "MOUNT_TABLE", table(tmp_path, "nfs4", tmp_path))
    monkeypatch.setenv(data_folder.ALLOW, "1")
    with Store.open(tmp_path / "runs"):
        pass
    monkeypatch.delenv(data_folder.ALLOW)
    answer = orthocapture("--allow-mount", "runs", "--data", str(tmp_path / "runs"), "--json")
    assert answer.returncode == 0, answer.stderr
    assert json.loads(answer.stdout) is not None
    assert data_folder.ALLOW not in os.environ


def test_doctor_says_so_and_counts_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(data_folder, "MOUNT_TABLE", table(tmp_path, "nfs4", tmp_path))
    rig = tmp_path / "rig.yaml"
    rig.write_text("name: bench\nsimulated: true\ndevices: {}\n")
    answer = CliRunner().invoke(app, ["doctor", "--rig", str(rig), "--data", str(tmp_path / "runs")])
    assert answer.exit_code == 1
    assert "the data folder is on a file system that other machines can mount too (nfs4)" in answer.output
