"""RFC 3161 time stamps from an authority that answers with `openssl ts`, and from one that misbehaves."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from rfc3161_client import HashAlgorithm, TimestampRequestBuilder

from service.audit import bundle_verifier
from service.audit.bundle import export_bundle
from service.core.records.run_events import DeviceTrouble
from service.rig import load_rig
from service.run_start import time_stamp_authority as time_stamp_authority_of
from service.store.records import TimestampError
from service.store.signatures.signing import checkpoint
from service.store.signatures.timestamps import Authority, stamp_end, timestamp
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.record.outsider import copy_data, rows, tamper
from tests.support.record.tampering import journal_anew
from tests.support.record.time_stamp_authority import (
    TimeStampAuthority,
    make_certificates,
    reply,
    time_stamp_authority,
)
from tests.support.runs.bench_run import PROTOCOL, begin_run, bench_store, record_runs


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TimeStampAuthority]:
    with time_stamp_authority(tmp_path_factory.mktemp("authority")) as authority:
        yield authority


@pytest.fixture
def authority(running: TimeStampAuthority) -> TimeStampAuthority:
    running.behaviour = "good"
    return running


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("run")
    run, _ = record_runs(folder)
    return folder / "data", run


@pytest.fixture
def data(recorded: tuple[Path, str], tmp_path: Path) -> Path:
    copy_data(recorded[0], tmp_path / "data")
    return tmp_path / "data"


def ask(authority: TimeStampAuthority) -> Authority:
    return Authority(authority.url, authority.certificates, timeout_s=30)


def test_a_checkpoint_is_stamped_once_and_verified_with_and_without_certificates(
    data: Path, recorded: tuple[Path, str], authority: TimeStampAuthority, tmp_path: Path
) -> None:
    run = recorded[1]
    with Store.open(data) as store:
        signed = checkpoint(store, run)
        asked = authority.asked
        stamp = timestamp(store, signed, ask(authority))
        assert authority.sent == "application/timestamp-query", "RFC 3161, 3.4"
        assert timestamp(store, signed, ask(authority)) == stamp
        assert authority.asked == asked + 1
        assert store.timestamps(run) == [stamp]
        bundle = export_bundle(store, run, tmp_path / "b.zip", actor="ada", hashes_only=True).path
    report = verify(data, run)
    assert (report.faults, report.timestamps) == ((), 1)
    assert "its signature was not checked" in " ".join(report.notes)
    report = verify(data, run, certificates=authority.certificates)
    assert report.faults == ()
    assert "not checked" not in " ".join(report.notes)
    other = make_certificates(tmp_path / "other")
    (fault,) = verify(data, run, certificates=other).faults
    assert "time stamp of http://127.0.0.1" in fault.what
    # The stand-alone verifier has its own parser for DER and CMS.
    for certificates, faults, said in (
        (None, 0, "its signature was not checked"),
        (authority.certificates, 0, "it existed at"),
        (other, 1, "no line of certificates"),
    ):
        check = bundle_verifier.Check()
        check.run(bundle, None, certificates)
        assert len(check.faults) == faults, check.faults
        assert said in " ".join([*check.notes, *(fault["what"] for fault in check.faults)])


def test_the_stand_alone_verifier_follows_the_certificates_to_one_that_was_given(tmp_path: Path) -> None:
    root, other = make_certificates(tmp_path / "one"), make_certificates(tmp_path / "other")
    query = TimestampRequestBuilder().data(b"this").hash_algorithm(HashAlgorithm.SHA256).build().as_bytes()
    token = bundle_verifier.Token(reply(tmp_path / "one", query))
    token.check_message(b"this")
    with pytest.raises(ValueError, match="something other"):
        token.check_message(b"that")
    token.check_signature(bundle_verifier.load_certificates(root))
    for unknown in (other, None):  # the other root has the same name and another key
        with pytest.raises(ValueError, match="no line of certificates"):
            token.check_signature(bundle_verifier.load_certificates(unknown))


def test_a_stamp_of_something_else_is_a_fault(
    data: Path, recorded: tuple[Path, str], authority: TimeStampAuthority
) -> None:
    run = recorded[1]
    with Store.open(data) as store:
        other = checkpoint(store, store.runs()[-1].run_id)
        timestamp(store, other, ask(authority))
        timestamp(store, checkpoint(store, run), ask(authority))
    ((token,),) = rows(data, f"SELECT token FROM timestamps WHERE run_id = '{other.run_id}'")
    tamper(data, f"UPDATE timestamps SET token = '{token}' WHERE run_id = '{run}'")
    journal_anew(data)
    for certificates in (None, authority.certificates):
        (fault,) = verify(data, run, certificates=certificates).faults
        assert fault.run_id == run
        assert "time stamp" in fault.what
    tamper(data, f"UPDATE timestamps SET token = 'AAAA' WHERE run_id = '{run}'")
    journal_anew(data)
    assert len(verify(data, run).faults) == 1


@pytest.mark.parametrize(
    ("behaviour", "said"),
    [
        ("silent", "closed connection"),
        ("garbage", "parse"),
        ("replay", "Nonce"),
        ("html", "it answered with text/html"),
        ("long", "its answer is too long"),
    ],
)
def test_an_authority_that_misbehaves_is_refused(
    data: Path, recorded: tuple[Path, str], authority: TimeStampAuthority, behaviour: str, said: str
) -> None:
    with Store.open(data) as store:
        signed = checkpoint(store, recorded[1])
        if not authority.first:
            timestamp(store, checkpoint(store, store.runs()[-1].run_id), ask(authority))
        authority.behaviour = behaviour
        with pytest.raises(TimestampError, match=f"no valid answer.*{said}"):
            timestamp(store, signed, ask(authority))
        assert store.timestamps(recorded[1]) == []
    assert verify(data, recorded[1]).ok


def test_an_answer_that_is_no_http_is_told_at_once(data: Path, recorded: tuple[Path, str]) -> None:
    """Otherwise the end of a run would wait until the time is up, and the reason would be lost."""
    with socket.create_server(("127.0.0.1", 0)) as server, Store.open(data) as store:

        def answer() -> None:
            peer, _ = server.accept()
            with peer:
                peer.recv(65536)
                peer.sendall(b"220 mail.example ESMTP\r\n")

        thread = threading.Thread(target=answer)
        thread.start()
        asked = Authority(f"http://127.0.0.1:{server.getsockname()[1]}/", Path("unused.pem"), timeout_s=60)
        with pytest.raises(TimestampError, match="its answer is not HTTP"):
            timestamp(store, checkpoint(store, recorded[1]), asked)
        thread.join()


def test_a_run_ends_signed_whether_or_not_the_authority_answers(
    data: Path, recorded: tuple[Path, str], authority: TimeStampAuthority
) -> None:
    run = recorded[1]
    with Store.open(data) as store:
        stamp_end(store, run, None)
        assert store.checkpoints(run)[-1].seq == len(store.events(run))
        assert store.timestamps(run) == []
        stamp_end(store, run, ask(authority))
        assert len(store.timestamps(run)) == 1
        store.record(run, [DeviceTrouble(device="x", error="E", message="m")], actor="test")
        stamp_end(store, run, Authority("http://127.0.0.1:9/", authority.certificates, timeout_s=1))
        trouble = store.events(run)[-1].payload
        assert isinstance(trouble, DeviceTrouble)
        assert (trouble.device, trouble.data_safe) == ("time-stamp authority", True)
        assert "refused" in trouble.message, "it says why, and not that there was no answer in time"
        assert store.checkpoints(run)[-1].seq == len(store.events(run))
    assert verify(data, run).ok


@pytest.mark.parametrize("end", ["completed", "aborted"])
def test_the_runner_has_the_end_of_a_run_stamped(tmp_path: Path, authority: TimeStampAuthority, end: str) -> None:
    with bench_store(tmp_path / "data") as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        bench.authority = ask(authority)
        if end == "aborted":
            bench.act("abort", reason="the specimen fell")
        assert bench.run().status == end
        (stamp,) = store.timestamps(bench.run_id)
        assert stamp.seq == len(store.events(bench.run_id)) == store.checkpoints(bench.run_id)[-1].seq
        asked = authority.asked
        bench.run()
        assert authority.asked == asked
    report = verify(tmp_path / "data", bench.run_id, certificates=authority.certificates)
    assert (report.faults, report.timestamps) == ((), 1)


@pytest.mark.parametrize("behaviour", ["asleep", "dripping"])
def test_an_authority_that_is_slow_delays_the_end_no_longer_than_allowed(
    tmp_path: Path, authority: TimeStampAuthority, behaviour: str
) -> None:
    authority.behaviour = behaviour
    with bench_store(tmp_path / "data") as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        bench.act("abort", reason="the specimen fell")
        bench.authority = Authority(authority.url, authority.certificates, timeout_s=0.4)
        assert bench.run().status == "aborted"
        (trouble,) = bench.payloads(DeviceTrouble)
        assert "nothing within 0.4 s" in trouble.message
        assert store.checkpoints(bench.run_id)[-1].seq == len(store.events(bench.run_id))
        authority.behaviour = "good"  # the next check of the run asks again
        bench.authority = ask(authority)
        assert bench.run().status == "aborted"
        assert len(store.timestamps(bench.run_id)) == 1
        bench.must_verify()


def test_the_rig_file_names_the_authority(tmp_path: Path, authority: TimeStampAuthority) -> None:
    (tmp_path / "rig.yaml").write_text(
        "name: r\ndevices: {}\ntimestamp: {url: 'https://tsa.example/', certificates: tsa.pem}\n"
    )
    section = load_rig(tmp_path / "rig.yaml").section.timestamp
    assert section is not None
    assert (section.url, section.certificates, section.timeout_s) == ("https://tsa.example/", "tsa.pem", 10.0)
    asked = time_stamp_authority_of(load_rig(tmp_path / "rig.yaml"))
    assert asked == Authority("https://tsa.example/", tmp_path.resolve() / "tsa.pem", 10.0)
