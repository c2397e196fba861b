"""What a database cannot hide: signatures are also in a log beside it, and nothing forged is signed."""

from __future__ import annotations

import base64
import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import rfc8785
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from typer.testing import CliRunner

from service.cli.main import app
from service.core.errors import IntegrityError
from service.core.records.events import StepPassed, StepStarted
from service.rig import load_rig
from service.run_start import signature_copy
from service.store.database.engine import database_path
from service.store.events import canonical
from service.store.records import SITE
from service.store.signatures.log import NAME, SignatureLog, read_log
from service.store.signatures.log_copy import bring_up_to_date, keep_elsewhere
from service.store.signatures.signing import checkpoint, public_keys, rotate_key
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import CountedIds, capture, start_run, tamper
from tests.support.record.tampering import WORDS_AGAIN, cut, journal_anew, rewrite_to_the_end, without_signatures_from
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
    return [*(f"DELETE FROM {table} WHERE run_id = '{run}'" for table in tables), *WORDS_AGAIN]


def forge(data: Path) -> None:
    """Rewrite the captures with all hashes, and delete the run's signatures."""
    run = run_of(data)
    rewrite_to_the_end(data, run, 2, actor="Eve")
    tamper(
        data,
        f"UPDATE event_index SET actor = 'Eve' WHERE run_id = '{run}'",
        *without_signatures_from(run, 1),
        *WORDS_AGAIN,
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
        (cut_a_run, "says (event 4) that another event was signed here: it was cut or rewritten"),
        (forge, "says (event 3) that another event was signed here: it was cut or rewritten"),
    ],
)
def test_the_sites_chain_tells_it_too(data: Path, attack: Callable[[Path], None], said: str) -> None:
    attack(data)
    assert any(said in fault for fault in faults(data)), faults(data)


@pytest.mark.parametrize("attack", [forge, forge_with_the_site, cut_a_run, take_the_log_away, alter_a_line])
def test_nothing_is_signed_after_it(data: Path, attack: Callable[[Path], None]) -> None:
    attack(data)
    with pytest.raises(IntegrityError, match="nothing is signed, because the record does not verify"):
        sign_again(data)


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
    bring_up_to_date(data, copy)
    assert copy.read_bytes() == (data / NAME).read_bytes()
    sign_again(data)
    report = verify(data, signatures_copy=copy)
    assert report.faults == ()
    assert f"{copy} does not have the last 2 lines of {NAME} yet" in report.notes
    bring_up_to_date(data, copy)
    # Everything is rolled back to the first run, log included: nothing within the folder shows it.
    lines = (data / NAME).read_bytes().splitlines(keepends=True)
    (data / NAME).write_bytes(b"".join(lines[:-2]))
    tamper(data, *cut(run_of(data), 5), *cut(SITE, 7))
    journal_anew(data)
    assert faults(data) == []
    (fault,) = verify(data, signatures_copy=copy).faults
    assert f"{NAME} ends before line {len(lines) - 1} of its copy: it was cut" in str(fault)
    with pytest.raises(IntegrityError, match="is not the beginning of the log"):
        bring_up_to_date(data, copy)
    (data / NAME).write_bytes(b"".join([*lines[:1], *lines[:1]]))
    assert str(verify(data, signatures_copy=copy).faults[-1]).startswith(f"{NAME}, line 2: it is not the line that")


def test_a_copy_that_cannot_be_written_is_told_and_caught_up_with(data: Path, tmp_path: Path) -> None:
    told: list[str] = []
    copy = tmp_path / "share" / "signatures.jsonl"
    keep_elsewhere(data, copy, told.append)
    assert "the copy of the log of signatures cannot be written: No such file or directory" in told[0]
    copy.parent.mkdir()
    copy.write_bytes((data / NAME).read_bytes()[:100])  # half a line, from a share that disappeared
    keep_elsewhere(data, copy, told.append)
    assert len(told) == 1
    assert copy.read_bytes() == (data / NAME).read_bytes()
    keep_elsewhere(data, None, told.append)


def test_half_a_line_of_a_power_cut_is_taken_away_by_the_next_signature(data: Path) -> None:
    whole = (data / NAME).read_bytes()
    (data / NAME).write_bytes(whole + b'{"number":')
    assert faults(data) == []
    sign_again(data)
    assert faults(data) == []
    assert (data / NAME).read_bytes().startswith(whole)


def test_a_signature_whose_line_a_crash_prevented_is_written_down_with_the_next(
    data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr("service.store.signatures.log.SignatureLog.add", lambda *_: None)
        sign_again(data)
    assert faults(data) == []
    assert any("is not in signatures.jsonl yet" in note for note in verify(data).notes)
    sign_again(data)
    assert verify(data).notes == ()


def test_only_the_newest_signatures_may_lack_their_line(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each signature writes down those that a crash left out, so that an older one without a line was taken out."""
    really = SignatureLog.add
    with monkeypatch.context() as patched:
        patched.setattr(SignatureLog, "add", lambda *_: None)
        sign_again(data)
        assert faults(data) == []
        patched.setattr(SignatureLog, "add", lambda log, every, key: really(log, every[-1:], key))
        sign_again(data)
    assert any(f"its signature is not in {NAME}" in fault for fault in faults(data)), faults(data)


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
    copy = signature_copy(load_rig(rig_file))
    assert copy is not None
    assert copy == tmp_path / "share" / "signatures.jsonl"
    copy.parent.mkdir()
    data = tmp_path / "data"
    with Store.open(data) as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        bench.signature_copy = copy
        assert bench.run().status == "completed"
    assert copy.read_bytes() == (data / NAME).read_bytes()
    words = ["audit", "verify", "--data", str(data), "--signatures", str(copy)]
    assert CliRunner().invoke(app, words).exit_code == 0
    (data / NAME).write_bytes(b"".join((data / NAME).read_bytes().splitlines(keepends=True)[:1]))
    cut_off = CliRunner().invoke(app, [*words, "--json"])
    assert cut_off.exit_code == 1
    assert f"{NAME} ends before line 2 of its copy" in cut_off.output
