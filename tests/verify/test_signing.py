"""Checkpoints: rewriting the evidence is detected; keys are made, kept, changed and lost without a gap."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli.audit import audit_app
from service.core.errors import IntegrityError
from service.core.records.events import SignInRecorded
from service.store.records import SITE, SigningKeyError, UnknownRunError
from service.store.signatures import signing
from service.store.signatures.checkpoints import KeyFolder, signed_by, statement
from service.store.signatures.signing import checkpoint, public_keys, rotate_key
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.record.outsider import INDEX_AGAIN, rows, signer_events, tamper
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import CountedIds, capture, start_run
from tests.support.record.tampering import alter_row, journal_anew, rewrite_to_the_end

ROOT_DIR = Path(__file__).parents[2]
RUN = "20261121-120000-000003"


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    """An unsigned run of three events."""
    with Store.open(tmp_path / "data", SteppedClock(), CountedIds()) as opened:
        assert start_run(opened) == RUN
        capture(opened, RUN, "v1")
        capture(opened, RUN, "v2")
        yield opened


def folder(store: Store) -> Path:
    return store.database_path.parent


def faults(store: Store, run_id: str | None = None) -> list[str]:
    return [str(fault) for fault in verify(folder(store), run_id).faults]


def site_event(store: Store) -> None:
    store.record_site([SignInRecorded(account="ada", outcome="signed_in")], actor="ada")


def kinds_of_site(store: Store) -> list[str]:
    """Return the kinds of the events of the site's chain, without the one that names who signs."""
    kinds = [event.payload.kind for event in store.events(SITE)]
    assert kinds.count("signer_named") == signer_events(folder(store))
    return [kind for kind in kinds if kind != "signer_named"]


def test_a_checkpoint_signs_the_end_of_the_chain_once(store: Store) -> None:
    made = checkpoint(store, RUN)
    assert checkpoint(store, RUN) == made
    assert (made.seq, made.sha256) == (3, store.events(RUN)[-1].sha256)
    assert json.loads(statement(made))["purpose"] == "orthocapture checkpoint v1"
    (key,) = public_keys(store)
    assert signed_by(made, key.public_key)
    assert not signed_by(replace(made, seq=2), key.public_key)
    capture(store, RUN, "v3")
    assert verify(folder(store), RUN).unsigned_events == {RUN: 1}
    assert "1 event after its last checkpoint (event 3)" in " ".join(verify(folder(store), RUN).notes)
    assert checkpoint(store, RUN).seq == 4
    assert [item.seq for item in store.checkpoints(RUN)] == [3, 4]
    assert checkpoint(store, SITE).run_id == SITE
    report = verify(folder(store))
    assert (report.faults, report.notes, report.key_ids) == ((), (), (key.key_id,))


def test_the_first_signature_makes_the_key_and_records_it(store: Store) -> None:
    made = checkpoint(store, RUN)
    ((private,),) = [list((folder(store) / "keys").iterdir())]
    assert stat.S_IMODE(private.stat().st_mode) == 0o600
    assert stat.S_IMODE(private.parent.stat().st_mode) == 0o700
    assert kinds_of_site(store) == ["site_opened", "key_changed", "run_signed"]
    assert made.site_seq == 2 + signer_events(folder(store))
    assert store.checkpoints(SITE)[0].seq == made.site_seq


def test_the_key_file_is_never_readable_by_others(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, tuple[int, int]] = {}
    really = os.open

    def watched(path: str, flags: int, mode: int = 0o777) -> int:
        descriptor = really(path, flags, mode)
        if flags & os.O_CREAT:
            seen[Path(path).parent.name] = (flags & os.O_EXCL, stat.S_IMODE(os.fstat(descriptor).st_mode))
        return descriptor

    monkeypatch.setattr(os, "open", watched)
    before = os.umask(0)
    try:
        checkpoint(store, RUN)
    finally:
        os.umask(before)
    assert seen["keys"] == (os.O_EXCL, 0o600)


def test_no_run_is_signed_while_the_sites_own_record_does_not_verify(store: Store) -> None:
    site_event(store)
    tamper(folder(store), f"UPDATE events SET actor = 'eve' WHERE run_id = '{SITE}' AND seq = 1")
    with pytest.raises(IntegrityError, match="nothing is signed"):
        checkpoint(store, RUN)
    assert store.checkpoints(RUN) == []


def test_a_chain_rewritten_to_its_end_is_found(store: Store) -> None:
    checkpoint(store, RUN)
    assert faults(store) == []
    rewrite_to_the_end(folder(store), RUN, 2, actor="Eve")
    journal_anew(folder(store))
    found = faults(store, RUN)
    assert found[0].startswith(f"run {RUN}, event 3: checkpoint: it signs an event with hash")
    assert "rewritten" in found[0]
    # The index of events was not rewritten with them, nor the site's chain about them.
    others = ("checkpoint: ", "index of events", "words by which", "the site's chain says")
    assert all(any(part in fault for part in others) for fault in found)


def test_a_row_altered_together_with_its_hash_is_found(store: Store) -> None:
    checkpoint(store, RUN)
    alter_row(folder(store), RUN, 3, "phone")
    journal_anew(folder(store))
    assert faults(store) == [
        f"run {RUN}, event 3: checkpoint: the rows of the artefacts up to it are not those that it signs"
    ]


def test_the_sites_chain_is_protected_by_the_runs(store: Store) -> None:
    """Its newest events are removed with their checkpoints: every run signed afterwards still refers to them."""
    checkpoint(store, SITE)
    site_event(store)
    checkpoint(store, RUN)
    last = 2 + signer_events(folder(store))
    tamper(
        folder(store),
        f"DELETE FROM checkpoints WHERE run_id = 'site' AND seq > {last}",
        f"DELETE FROM events WHERE run_id = 'site' AND seq > {last}",
        f"DELETE FROM event_index WHERE run_id = 'site' AND seq > {last}",
        f"UPDATE heads SET seq = {last}, sha256 = (SELECT sha256 FROM events WHERE run_id = 'site' AND seq = {last}) "
        "WHERE run_id = 'site'",
        *INDEX_AGAIN,
    )
    journal_anew(folder(store))
    found = faults(store, RUN)
    assert (
        found[0]
        == f"run {RUN}, event 3: checkpoint: event {last + 1} of the site's chain is not the one that it names"
    )
    assert all("signatures.jsonl" in fault for fault in found[1:]), "they were written down outside of the database"
    assert found[1:]


CHECKPOINT_TAMPERING = {
    "signature": ("signature is not valid", "UPDATE checkpoints SET signature = 'AAAA'"),
    "time": ("signature is not valid", "UPDATE checkpoints SET at_utc = '2026-11-21T11:00:00.000000Z'"),
    "key": ("does not know", f"UPDATE checkpoints SET key_id = '{'0' * 64}'"),
    "event": ("not there", f"UPDATE checkpoints SET seq = 9 WHERE run_id = '{RUN}'"),
    "site": ("not the one that it names", f"UPDATE checkpoints SET site_seq = 1 WHERE run_id = '{RUN}'"),
}


@pytest.mark.parametrize("name", CHECKPOINT_TAMPERING)
def test_tampering_with_checkpoints_is_named(store: Store, name: str) -> None:
    checkpoint(store, RUN)
    said, statement_ = CHECKPOINT_TAMPERING[name]
    tamper(folder(store), statement_)
    assert any(said in fault for fault in faults(store, RUN)), faults(store, RUN)


def test_another_key_in_the_sites_chain_is_found(store: Store) -> None:
    """Replacing the key's event requires rewriting the site's chain, which the runs' checkpoints refer to."""
    checkpoint(store, RUN)
    rewrite_to_the_end(folder(store), SITE, 2, actor="Eve")
    found = faults(store, RUN)
    named = 2 + signer_events(folder(store))
    assert any(f"run site, event {named}" in fault and "rewritten" in fault for fault in found)
    assert any(f"event {named} of the site's chain is not" in fault for fault in found)


def test_nothing_is_signed_at_the_end_of_a_cut_chain(store: Store) -> None:
    tamper(folder(store), f"DELETE FROM events WHERE run_id = '{RUN}' AND seq = 3")
    with pytest.raises(IntegrityError):
        checkpoint(store, RUN)
    with pytest.raises(UnknownRunError):
        checkpoint(store, "nothing")
    assert store.checkpoints(RUN) == []


def test_a_new_key_is_vouched_for_by_the_old_one_which_is_destroyed(store: Store) -> None:
    checkpoint(store, RUN)
    (first,) = public_keys(store)
    capture(store, RUN, "v3")
    second = rotate_key(store, reason="yearly", actor="ada")
    assert [path.stem for path in (folder(store) / "keys").iterdir()] == [second.key_id]
    assert second.introduced
    assert [key.key_id for key in public_keys(store)] == [first.key_id, second.key_id]
    assert checkpoint(store, RUN).key_id == second.key_id
    assert [item.key_id for item in store.checkpoints(SITE)] == [*[first.key_id] * 3, second.key_id]
    site_event(store)
    assert checkpoint(store, SITE).key_id == second.key_id
    report = verify(folder(store))
    assert (report.faults, report.notes) == ((), ())
    # Without the signature that introduced it, the new key could be anybody's.
    tamper(folder(store), f"DELETE FROM checkpoints WHERE run_id = 'site' AND seq = {second.seq}")
    assert "not vouched for" in " ".join(verify(folder(store), RUN).notes)


def test_an_old_key_signs_nothing_new(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """A copy of the old private key is used after its replacement."""
    checkpoint(store, RUN)
    (first,) = public_keys(store)
    stolen = KeyFolder(folder(store), store.files).load(first.key_id)
    rotate_key(store, reason="suspicion", actor="ada")
    capture(store, RUN, "v3")
    monkeypatch.setattr(signing, "_present_key", lambda *_: stolen)
    checkpoint(store, RUN)
    named = 4 + signer_events(folder(store))
    assert any(f"was not in use at event {named} of the site's chain" in fault for fault in faults(store, RUN))


def test_a_lost_key_is_replaced_and_the_gap_is_told(store: Store) -> None:
    checkpoint(store, RUN)
    with pytest.raises(SigningKeyError, match="not lost"):
        rotate_key(store, reason="?", actor="ada", lost=True)
    next((folder(store) / "keys").iterdir()).unlink()
    capture(store, RUN, "v3")
    with pytest.raises(SigningKeyError, match="missing") as caught:
        checkpoint(store, RUN)
    assert "rotate-key --lost" in caught.value.remedy
    with pytest.raises(SigningKeyError, match="missing"):
        rotate_key(store, reason="disk died", actor="ada")
    assert not rotate_key(store, reason="disk died", actor="ada", lost=True).introduced
    checkpoint(store, RUN)
    report = verify(folder(store))
    assert report.ok
    assert "was not vouched for by the key before it (disk died)" in " ".join(report.notes)


def test_a_key_that_others_can_read_is_refused(store: Store) -> None:
    checkpoint(store, RUN)
    next((folder(store) / "keys").iterdir()).chmod(0o644)
    capture(store, RUN, "v3")
    with pytest.raises(SigningKeyError, match="read by other users"):
        checkpoint(store, RUN)


class Crash(BaseException):
    pass


def crash(*_: object, **__: object) -> None:
    raise Crash


@pytest.mark.parametrize("at", ["_record_key", "insert_checkpoint"])
def test_a_crash_while_the_first_key_is_made_leaves_nothing_dangling(
    store: Store, monkeypatch: pytest.MonkeyPatch, at: str
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(signing, at, crash)
        with pytest.raises(Crash):
            checkpoint(store, RUN)
    (left,) = [path.stem for path in (folder(store) / "keys").iterdir()]
    assert checkpoint(store, RUN).key_id == left
    assert kinds_of_site(store) == ["site_opened", "key_changed", "run_signed"]
    assert faults(store) == []


@pytest.mark.parametrize("at", ["_record_key", "insert_checkpoint", "destroy_all_but"])
def test_a_crash_while_the_key_is_changed_leaves_one_key(
    store: Store, monkeypatch: pytest.MonkeyPatch, at: str
) -> None:
    checkpoint(store, RUN)
    (first,) = public_keys(store)
    with monkeypatch.context() as patched:
        patched.setattr(KeyFolder if at == "destroy_all_but" else signing, at, crash)
        site_event(store)
        with pytest.raises(Crash):
            rotate_key(store, reason="yearly", actor="ada")
    capture(store, RUN, "v3")
    made = checkpoint(store, RUN)
    assert [path.stem for path in (folder(store) / "keys").iterdir()] == [made.key_id]
    assert (made.key_id == first.key_id) == (len(public_keys(store)) == 1)
    assert faults(store) == []


@pytest.mark.slow
def test_several_processes_sign_with_one_key(store: Store) -> None:
    code = (
        "import sys, pathlib\nfrom service.store.store import Store\n"
        "from service.store.signatures.signing import checkpoint\n"
        "with Store.open(pathlib.Path(sys.argv[1])) as store: checkpoint(store, sys.argv[2])"
    )
    processes = [
        subprocess.Popen([sys.executable, "-c", code, str(folder(store)), run], cwd=ROOT_DIR) for run in (RUN, SITE)
    ]
    assert [process.wait(timeout=60) for process in processes] == [0, 0]
    assert len(public_keys(store)) == 1
    assert len(store.checkpoints(RUN)) == 1
    assert faults(store) == []


def test_only_the_run_asked_for_and_the_site_are_read(store: Store) -> None:
    checkpoint(store, RUN)
    other = start_run(store)
    tamper(folder(store), f"UPDATE events SET actor = 'Eve' WHERE run_id = '{other}'")
    assert verify(folder(store), RUN).ok
    assert verify(folder(store), RUN).runs == (RUN,)
    tamper(folder(store), "UPDATE events SET actor = 'Eve' WHERE run_id = 'site' AND seq = 2")
    assert any(fault.startswith("run site, event 2: the content was altered") for fault in faults(store, RUN))
    assert len(rows(folder(store), "SELECT * FROM checkpoints")) == 3


# --- command line ---


def run_cli(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(audit_app, arguments, env={"COLUMNS": "200"})
    assert result.exception is None or isinstance(result.exception, SystemExit)
    return result.exit_code, result.stdout + result.stderr


def test_commands_sign_show_and_change_the_key(store: Store) -> None:
    data = ("--data", str(folder(store)))
    assert run_cli("keys", *data) == (0, "No key has signed anything in this folder yet.\n")
    status, said = run_cli("checkpoint", "latest", *data)
    assert (status, "event 3" in said) == (0, True)
    status, said = run_cli("rotate-key", "--reason", "yearly", "--operator", "ada", *data)
    assert status == 0
    status, said = run_cli("keys", "--json", *data)
    keys = json.loads(said)["keys"]
    assert [key["in_use"] for key in keys] == [False, True]
    assert run_cli("rotate-key", *data)[0] == 2
    status, said = run_cli("verify", "latest", *data)
    assert status == 0
    assert keys[1]["key_id"] in said
