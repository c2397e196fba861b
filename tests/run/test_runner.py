"""A run from its first question to its end, when nothing goes wrong: what the runner does and records."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from service.core.errors import ConfigurationError, StoreError
from service.core.records.run_events import DeviceOpened, SessionStarted, ViewpointCaptured
from service.run_start import recorded_rig, recorded_run
from service.store.records import Checkpoint, LeaseHeldError, RecordDamagedError
from service.store.restoring import rebuild
from service.store.signatures import timestamps as timestamping
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.runs.bench_run import PROTOCOL, VIEWS, Bench, begin_run, bench_store


def test_a_run_goes_from_its_checklist_through_the_captures_to_its_end(bench: Bench) -> None:
    state = bench.run()
    assert state.status == "completed"
    assert bench.captured() == VIEWS
    assert state.deviations == ()
    assert [(d.device, d.report["identity"]["serial"]) for d in bench.payloads(DeviceOpened)] == [
        ("camera", "C-1"),
        ("robot", "A-1"),
    ]
    photographs = [row for row in bench.store.artefacts(bench.run_id) if row.ref.kind == "image"]
    assert [row.viewpoint for row in photographs] == VIEWS
    assert len({row.ref.sha256 for row in photographs}) == len(VIEWS)
    capture = bench.payloads(ViewpointCaptured)[0]
    assert capture.environment == {"light_lux": 812.0, "temperature_c": 21.5}
    assert capture.camera["counter"] == 1
    assert capture.pose_samples > 5
    assert bench.state() == state
    bench.must_verify()


def test_the_protocol_and_rig_of_a_run_are_its_evidence(bench: Bench) -> None:
    protocol, root = recorded_run(bench.store, bench.run_id)
    assert protocol.step_ids == ("fixation", "capture", "spraying")
    rig = recorded_rig(bench.store, root)
    rig.path.write_text("name: another\ndevices: {}\n")
    with pytest.raises(ConfigurationError, match="changed since the run began"):
        recorded_rig(bench.store, root)


def test_a_completed_run_is_not_touched_again(bench: Bench) -> None:
    bench.run()
    before = bench.store.events(bench.run_id)
    assert bench.run().status == "completed"
    assert bench.store.events(bench.run_id) == before


def test_the_end_of_a_run_that_could_not_be_signed_is_signed_when_it_is_resumed(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk was full at that moment, or the process was killed, and there may be nothing left to compute."""
    sign = timestamping.checkpoint

    def full(store: Store, run_id: str) -> Checkpoint:
        if bench.state().terminal:
            raise StoreError("no space left")
        return sign(store, run_id)

    with monkeypatch.context() as patch:
        patch.setattr(timestamping, "checkpoint", full)
        assert bench.run().status == "completed"
    assert verify(bench.data).unsigned_events[bench.run_id] > 0
    assert bench.run().status == "completed"
    assert verify(bench.data).unsigned_events[bench.run_id] == 0


def test_one_run_has_one_runner(bench: Bench) -> None:
    with bench.store.lease(bench.run_id, "another runner", 30), pytest.raises(LeaseHeldError):
        bench.run()
    assert not bench.payloads(SessionStarted)


@pytest.mark.sqlite("damages SQLite's file")
def test_a_database_that_is_moved_away_in_the_capture_ends_the_run_loudly(tmp_path: Path) -> None:
    data = tmp_path / "data"

    def move_away(_seconds: float) -> None:
        if bench.captured():
            for path in data.glob("orthocapture.sqlite*"):
                path.rename(path.with_name(f"gone-{path.name}"))

    with bench_store(data) as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        bench.on_wait = move_away
        with pytest.raises(StoreError, match=r"orthocapture\.sqlite was removed while it was in use"):
            bench.run()
    for path in data.glob("gone-*"):
        path.rename(path.with_name(path.name.removeprefix("gone-")))
    report = verify(data)
    assert report.faults == ()
    assert any(note.startswith("artefacts/") for note in report.notes), report.notes


@pytest.mark.sqlite("damages SQLite's file")
def test_a_write_ahead_log_that_is_cut_in_the_capture_ends_the_run_and_loses_nothing(
    tmp_path: Path,
) -> None:
    data = tmp_path / "data"
    seen: list[str] = []

    def cut(_seconds: float) -> None:
        if len(bench.captured()) == 2 and not seen:
            seen.extend(bench.captured())
            os.truncate(data / "orthocapture.sqlite-wal", 0)

    with bench_store(data) as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        bench.on_wait = cut
        with pytest.raises(StoreError) as told:
            bench.run()
        assert "store rebuild" in told.value.remedy
    assert len(seen) == 2
    assert rebuild(data, actor=lambda _folder: "Ada").lost == ()
    with bench_store(data) as store:
        again = Bench(store, bench.run_id, data, bench.rig)
        assert again.captured()[:2] == seen
        assert again.run().status == "completed"
        assert len(set(again.captured())) == len(again.captured())
        again.must_verify()


@pytest.mark.sqlite("backups and journal: a server has its own")
def test_a_paused_run_notices_within_a_second_that_the_record_was_altered(tmp_path: Path) -> None:
    data = tmp_path / "data"
    waited_s: list[float] = []

    def cut(seconds: float) -> None:
        if bench.state().status == "paused":
            if not waited_s:
                os.truncate(data / "journal.jsonl", 0)
            waited_s.append(seconds)

    with bench_store(data) as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        bench.act("pause")
        bench.on_wait = cut
        with pytest.raises(RecordDamagedError, match=r"journal\.jsonl was removed, replaced, cut or altered"):
            bench.run()
    assert 0 < sum(waited_s) <= 1.2
