"""What a database cannot hide: signatures are also in a log beside it, and nothing forged is signed."""

from __future__ import annotations

import base64
import hashlib
import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import rfc8785
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from sqlalchemy import Connection
from typer.testing import CliRunner

from service.cli.main import app
from service.core.errors import IntegrityError, StoreError
from service.core.records.events import SignInRecorded
from service.core.records.run_events import StepPassed, StepStarted
from service.rig import load_rig
from service.run_start import second_place, signature_copy
from service.store.database.engine import database_path
from service.store.durable_effects import DurableFiles
from service.store.events import canonical
from service.store.records import SITE, Checkpoint
from service.store.signatures.log import NAME, LogEnd, SeenSignatures, SignatureLog, read_log
from service.store.signatures.second_place import LogCopy
from service.store.signatures.signing import checkpoint, public_keys, rotate_key
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.record.counting import lines_of
from tests.support.record.outsider import INDEX_AGAIN, signer_events, tamper
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import CountedIds, capture, start_run
from tests.support.record.tampering import cut, journal_anew, rewrite_to_the_end, without_signatures_from
from tests.support.runs.bench_run import PROTOCOL, begin_run


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Two runs of four events each, signed after the third and at the end."""
    folder = tmp_path / "data"
    with Store.open(folder, SteppedClock(), CountedIds()) as store:
        for _ in range(2):
            run = start_run(store)
            capture(store, run, "v1")
            capture(store, run, "v2")
            checkpoint(store, run)
            capture(store, run, "v3")
            checkpoint(store, run)
    return folder


def run_of(data: Path) -> str:
    with Store.open(data) as store:
        return store.runs()[0].run_id


def faults(data: Path) -> list[str]:
    return [str(fault) for fault in verify(data).faults]


def sign_again(data: Path) -> None:
    """Sign as the next program does, which has verified nothing yet."""
    with Store.open(data) as store:
        capture(store, run_of(data), "v9")
        checkpoint(store, run_of(data))


def deleted(run: str) -> list[str]:
    tables = ("checkpoints", "artefacts", "event_index", "heads", "events", "runs")
    return [*(f"DELETE FROM {table} WHERE run_id = '{run}'" for table in tables), *INDEX_AGAIN]


def forge(data: Path) -> None:
    """Rewrite the captures with all hashes, and delete the run's signatures."""
    run = run_of(data)
    rewrite_to_the_end(data, run, 2, actor="Eve")
    tamper(
        data,
        f"UPDATE event_index SET actor = 'Eve' WHERE run_id = '{run}'",
        *without_signatures_from(run, 1),
        *INDEX_AGAIN,
    )


def forge_with_the_site(data: Path) -> None:
    forge(data)
    tamper(data, *cut(SITE, 3))


def cut_a_run(data: Path) -> None:
    tamper(data, *cut(run_of(data), 4))


def cut_a_run_and_the_site(data: Path) -> None:
    tamper(data, *cut(run_of(data), 4), *cut(SITE, 4))


def delete_a_run(data: Path) -> None:
    tamper(data, *deleted(run_of(data)))


def delete_a_run_and_cut_the_site(data: Path) -> None:
    tamper(data, *deleted(run_of(data)), *cut(SITE, 3))


def take_the_log_away(data: Path) -> None:
    (data / NAME).unlink()


def empty_the_log(data: Path) -> None:
    (data / NAME).write_bytes(b"")


def cut_the_log(data: Path) -> None:
    lines = (data / NAME).read_bytes().splitlines(keepends=True)
    (data / NAME).write_bytes(b"".join(lines[:3]))


def take_a_line_out(data: Path) -> None:
    lines = (data / NAME).read_bytes().splitlines(keepends=True)
    (data / NAME).write_bytes(b"".join([*lines[:2], *lines[3:]]))


def alter_a_line(data: Path) -> None:
    (data / NAME).write_bytes((data / NAME).read_bytes().replace(b'"number":2', b'"number": 2', 1))


def sign_the_last_line_otherwise(data: Path) -> None:
    """No line after it holds its hash: only its own signature protects it."""
    *lines, before, last = (data / NAME).read_bytes().splitlines(keepends=True)
    other = canonical({**json.loads(last), "signature": json.loads(before)["signature"]}).encode() + b"\n"
    (data / NAME).write_bytes(b"".join([*lines, before, other]))


ATTACKS = [
    forge,
    forge_with_the_site,
    cut_a_run,
    cut_a_run_and_the_site,
    delete_a_run,
    delete_a_run_and_cut_the_site,
    take_the_log_away,
    empty_the_log,
    cut_the_log,
    take_a_line_out,
    alter_a_line,
    sign_the_last_line_otherwise,
]


@pytest.mark.parametrize("attack", ATTACKS, ids=lambda attack: attack.__name__)
def test_every_attack_shows(data: Path, attack: Callable[[Path], None]) -> None:
    assert faults(data) == []
    attack(data)
    assert faults(data)


@pytest.mark.parametrize(
    ("attack", "said"),
    [
        (delete_a_run, "and is no longer here: it was deleted"),
        (cut_a_run, "says (event {4}) that another event was signed here: it was cut or rewritten"),
        (forge, "says (event {3}) that another event was signed here: it was cut or rewritten"),
    ],
)
def test_the_sites_chain_tells_it_too(data: Path, attack: Callable[[Path], None], said: str) -> None:
    attack(data)
    for seq in (3, 4):  # in the chain of a cart
        said = said.replace(f"{{{seq}}}", str(seq + signer_events(data)))
    assert any(said in fault for fault in faults(data)), faults(data)


@pytest.mark.parametrize("attack", [forge, forge_with_the_site, cut_a_run, take_the_log_away, alter_a_line])
def test_nothing_is_signed_after_it(data: Path, attack: Callable[[Path], None]) -> None:
    attack(data)
    with pytest.raises(IntegrityError, match="nothing is signed, because the record does not verify"):
        sign_again(data)


@pytest.mark.sqlite("damages SQLite's file")
def test_a_database_put_back_as_it_was_shows(data: Path, tmp_path: Path) -> None:
    with Store.open(data) as store:
        store.database.close()
    copy = tmp_path / "copy"
    shutil.copy(database_path(data), copy)
    sign_again(data)
    for left in data.glob("orthocapture.sqlite*"):
        left.unlink()
    shutil.copy(copy, database_path(data))
    assert any("is no longer here: what it signed was removed" in fault for fault in faults(data))


def test_each_line_is_signed_with_its_place_and_its_purpose_in_canonical_json(data: Path) -> None:
    """What an auditor has who reads the log without this software, and what lines of earlier versions have."""
    with Store.open(data) as store:
        keys = {one.key_id: Ed25519PublicKey.from_public_bytes(one.public_key) for one in public_keys(store)}
    previous = "0" * 64
    for number, raw in enumerate((data / NAME).read_bytes().splitlines(keepends=True), 1):
        line = json.loads(raw)
        signature = base64.b64decode(line.pop("signature"))
        assert (line["number"], line["previous_sha256"]) == (number, previous)
        signed = rfc8785.dumps({**line, "purpose": "orthocapture signature log v1"})
        keys[line["key_id"]].verify(signature, signed)
        previous = hashlib.sha256(raw).hexdigest()


def test_no_key_is_replaced_while_the_sites_own_record_does_not_verify(data: Path) -> None:
    tamper(data, f"UPDATE events SET actor = 'eve' WHERE run_id = '{SITE}' AND seq = 1")
    with Store.open(data) as store:
        before = public_keys(store)
        with pytest.raises(IntegrityError, match="nothing is signed"):
            rotate_key(store, reason="yearly", actor="ada")
        assert public_keys(store) == before


def test_the_log_follows_the_key(data: Path) -> None:
    with Store.open(data) as store:
        rotate_key(store, reason="yearly", actor="ada")
    before = read_log(data / NAME)
    assert before is not None
    assert len({line.key_id for line in before}) == 1, "the old key signs until the end of its life"
    sign_again(data)
    assert faults(data) == []
    lines = read_log(data / NAME)
    assert lines is not None
    assert len({line.key_id for line in lines}) == 2


def test_a_signature_made_while_the_evidence_is_verified_is_no_fault(data: Path) -> None:
    signed: list[str] = []

    def sign_meanwhile(*_: object) -> None:
        if not signed:  # once, while the files are read
            sign_again(data)
            signed.append(run_of(data))

    report = verify(data, progress=sign_meanwhile)
    assert signed != []
    assert report.faults == ()
    assert verify(data).faults == ()


def test_a_log_that_was_cut_or_changed_shows_against_its_copy(data: Path, tmp_path: Path) -> None:
    copy = tmp_path / "elsewhere.jsonl"
    LogCopy(data / NAME, copy).bring_up_to_date()
    assert copy.read_bytes() == (data / NAME).read_bytes()
    sign_again(data)
    report = verify(data, signatures_copy=copy)
    assert report.faults == ()
    assert f"{copy} does not have the last 2 lines of {NAME} yet" in report.notes
    LogCopy(data / NAME, copy).bring_up_to_date()
    # Everything is rolled back to the first run, log included: nothing within the folder shows it.
    lines = (data / NAME).read_bytes().splitlines(keepends=True)
    (data / NAME).write_bytes(b"".join(lines[:-2]))
    tamper(data, *cut(run_of(data), 5), *cut(SITE, 7 + signer_events(data)))
    journal_anew(data)
    assert faults(data) == []
    (fault,) = verify(data, signatures_copy=copy).faults
    assert f"{NAME} ends before line {len(lines) - 1} of its copy: it was cut" in str(fault)
    with pytest.raises(IntegrityError, match="is not the beginning of the log"):
        LogCopy(data / NAME, copy).bring_up_to_date()
    (data / NAME).write_bytes(b"".join([*lines[:1], *lines[:1]]))
    assert str(verify(data, signatures_copy=copy).faults[-1]).startswith(f"{NAME}, line 2: it is not the line that")


def test_half_a_line_in_the_copy_is_written_over(data: Path, tmp_path: Path) -> None:
    copy = tmp_path / "elsewhere.jsonl"
    copy.write_bytes((data / NAME).read_bytes()[:100])  # from a share that disappeared
    LogCopy(data / NAME, copy).bring_up_to_date()
    assert copy.read_bytes() == (data / NAME).read_bytes()


def test_half_a_line_of_a_power_cut_is_taken_away_by_the_next_signature(data: Path) -> None:
    whole = (data / NAME).read_bytes()
    (data / NAME).write_bytes(whole + b'{"number":')
    assert faults(data) == []
    sign_again(data)
    assert faults(data) == []
    assert (data / NAME).read_bytes().startswith(whole)


def test_a_signature_whose_line_a_crash_prevented_is_written_down_with_the_next_which_says_so(
    data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr("service.store.signatures.log.SignatureLog.add", lambda *_: None)
        sign_again(data)
    assert faults(data) == []
    assert any("is not in signatures.jsonl yet" in note for note in verify(data).notes)
    sign_again(data)
    assert faults(data) == []
    (note,) = verify(data).notes
    assert f"2 lines were missing from the end of {NAME}" in note
    assert "and written again, as after a power failure" in note
    for _ in range(3):
        sign_again(data)
    assert verify(data).notes == (note,), "once, and for ever"


def test_only_the_newest_signatures_may_lack_their_line(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each signature writes down those that a crash left out, so that an older one without a line was taken out."""
    really = SignatureLog.add

    def add_the_last(log: SignatureLog, end: LogEnd, made: Sequence[Checkpoint], key: Ed25519PrivateKey) -> None:
        really(log, end, made[-1:], key)

    with monkeypatch.context() as patched:
        patched.setattr(SignatureLog, "add", add_the_last)
        sign_again(data)
    (fault,) = faults(data)
    assert f"its signature is not in {NAME}" in fault
    sign_again(data)
    (fault,) = faults(data)
    assert f"1 line was missing from the end of {NAME}" in fault


@pytest.mark.parametrize("lines", [4, 6])
def test_a_log_that_was_cut_by_more_stays_a_fault_of_the_runs_concerned(data: Path, lines: int) -> None:
    """Two lines a signature: more than two signatures were never without a line at once."""
    whole = (data / NAME).read_bytes()
    (data / NAME).write_bytes(b"".join(whole.splitlines(keepends=True)[:-lines]))
    assert len(faults(data)) == lines
    with Store.open(data) as store:
        other = start_run(store)
        capture(store, other, "v1")
        checkpoint(store, other)
    assert (data / NAME).read_bytes().count(b"\n") > whole.count(b"\n")
    (fault,) = faults(data)
    assert f"{lines} lines were missing from the end of {NAME}" in fault
    assert "and written again: the log was cut" in fault
    report = verify(data, other)
    assert report.ok, "a run that was signed since is not in doubt"
    assert any("None of them was of this run" in note for note in report.notes)


def test_a_log_that_is_cut_while_it_is_in_use_is_told_as_well(data: Path) -> None:
    with Store.open(data) as store:
        run = run_of(data)
        capture(store, run, "v4")
        checkpoint(store, run)
        lines = (data / NAME).read_bytes().splitlines(keepends=True)
        (data / NAME).write_bytes(b"".join(lines[:-6]))
        capture(store, run, "v5")
        checkpoint(store, run)
    (fault,) = faults(data)
    assert f"6 lines were missing from the end of {NAME}" in fault


def test_a_line_altered_while_the_log_is_in_use_forbids_the_next_signature(data: Path) -> None:
    with Store.open(data) as store:
        run = run_of(data)
        capture(store, run, "v4")
        checkpoint(store, run)
        sign_the_last_line_otherwise(data)
        capture(store, run, "v5")
        checkpoint(store, run)  # of a line that is signed otherwise only `audit verify` knows
        assert any("its own signature is not valid" in fault for fault in faults(data))
        alter_a_line(data)
        (data / NAME).write_bytes((data / NAME).read_bytes()[:-20])
        capture(store, run, "v6")
        with pytest.raises(IntegrityError, match="nothing is signed"):
            checkpoint(store, run)


def test_missing_lines_are_written_before_anything_new_is_signed(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So a disk that refuses for long leaves no more lines missing than one signature has."""

    with Store.open(data) as store:
        run = run_of(data)
        append = store.files.append

        def refused(path: Path, *rest: Any) -> None:
            if path.name == NAME:
                raise OSError(28, "No space left on device")
            append(path, *rest)

        with monkeypatch.context() as patched:
            patched.setattr(store.files, "append", refused)
            for viewpoint in ("v4", "v5", "v6"):
                capture(store, run, viewpoint)
                with pytest.raises(StoreError, match="cannot be written: No space left on device"):
                    checkpoint(store, run)
        assert faults(data) == []
        site = store.head(SITE)
        checkpoint(store, run)
        assert store.head(SITE) == site + 1, "what was missing is told once"
    assert faults(data) == []
    assert verify(data).unsigned_events == dict.fromkeys(verify(data).unsigned_events, 0)


def test_whoever_signs_waits_for_the_one_who_signs(data: Path) -> None:
    with (
        Store.open(data) as first,
        Store.open(data, patience_s=0.02) as second,
        first.signature_log.alone(),
        pytest.raises(StoreError, match="another process has been signing for too long"),
    ):
        checkpoint(second, SITE)


def test_the_first_look_of_a_process_which_reads_everything_keeps_nobody_waiting(
    data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    really, free = SeenSignatures.look, list[bool]()

    def look(seen: SeenSignatures, connection: Connection) -> None:
        try:
            with SignatureLog(data, DurableFiles(), patience_s=0.0).alone():
                free.append(True)
        except StoreError:
            free.append(False)
        really(seen, connection)

    run = run_of(data)
    monkeypatch.setattr(SeenSignatures, "look", look)
    with Store.open(data) as store:
        for viewpoint in ("v4", "v5"):
            capture(store, run, viewpoint)
            checkpoint(store, run)
    assert free == [True, False, False], "first without the others waiting, then for what is new"


@pytest.mark.slow
def test_a_signature_costs_the_same_however_old_the_site_is(data: Path) -> None:
    """Counted in executed lines of the program and of the libraries by which it reads the database and the log."""

    def signature(store: Store) -> int:
        store.record_site([SignInRecorded(account="ada", outcome="signed_in")], actor="ada")
        return lines_of(lambda: checkpoint(store, SITE), "/")

    with Store.open(data) as store:
        run = run_of(data)
        signature(store)
        young = signature(store)
        for number in range(40):
            capture(store, run, f"w{number}")
            checkpoint(store, run)
        signature(store)
        assert signature(store) <= 1.02 * young


def test_a_passed_step_that_is_followed_by_another_has_its_signature(data: Path) -> None:
    run = run_of(data)
    with Store.open(data) as store:
        for step in ("a", "b"):
            store.record(run, [StepStarted(step=step, attempt=1), StepPassed(step=step, attempt=1)], actor="runner")
        assert any("step passed was never signed" in fault for fault in faults(data))
        checkpoint(store, run)
    assert faults(data) == []


def test_a_run_keeps_the_copy_that_its_rig_file_names(tmp_path: Path) -> None:
    rig_file = tmp_path / "rig.yaml"
    rig_file.write_text("name: r\ndevices: {}\nsignature_copy: share/signatures.jsonl\n")
    rig = load_rig(rig_file)
    copy = signature_copy(rig)
    assert copy is not None
    assert copy == tmp_path / "share" / "signatures.jsonl"
    copy.parent.mkdir()
    data = tmp_path / "data"
    with Store.open(data) as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        bench.second_place = second_place(rig, store)
        assert bench.run().status == "completed"
    assert copy.read_bytes() == (data / NAME).read_bytes()
    words = ["audit", "verify", "--data", str(data), "--signatures", str(copy)]
    assert CliRunner().invoke(app, words).exit_code == 0
    (data / NAME).write_bytes(b"".join((data / NAME).read_bytes().splitlines(keepends=True)[:1]))
    cut_off = CliRunner().invoke(app, [*words, "--json"])
    assert cut_off.exit_code == 1
    assert f"{NAME} ends before line 2 of its copy" in cut_off.output
