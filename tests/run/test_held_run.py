"""What a runner holds and leaves behind: the lease of its run, and a signed chain."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.core.protocol import Protocol, parse_protocol
from service.core.records.run_events import StepNote
from service.runner.held_run import held_run
from service.runner.upkeep import Seal
from service.steps import params_models
from service.store.durable_effects import DurableFiles, Files
from service.store.records import LeaseHeldError
from service.store.signatures.second_place import SecondPlace
from service.store.signatures.timestamps import Authority
from service.store.store import Store
from tests.support.processes.faulty_disk import FaultyDisk
from tests.support.runs.bench_run import PROTOCOL, begin_run

NOTE = StepNote(step="fixation", attempt=1, note="seen")
NOBODY = Authority(url="http://127.0.0.1:1/tsa", certificates=Path("none.pem"), timeout_s=1.0)


@pytest.fixture
def disk() -> Files:
    return DurableFiles()


@pytest.fixture
def store(tmp_path: Path, disk: Files) -> Iterator[Store]:
    with Store.open(tmp_path / "data", files=disk) as opened:
        yield opened


@pytest.fixture
def run_id(store: Store, tmp_path: Path) -> str:
    return begin_run(store, PROTOCOL, tmp_path).run_id


@pytest.fixture
def protocol() -> Protocol:
    return parse_protocol(PROTOCOL.encode(), params_models(), name="bench.yaml").protocol


class Told:
    """What the operator was told."""

    def __init__(self) -> None:
        self.busy: list[str] = []
        self.lines: list[str] = []

    def seal(
        self, store: Store, run_id: str, *, authority: Authority | None = None, copy: Path | None = None
    ) -> Seal:
        place = SecondPlace.of(store.database_path.parent, copy, store.clock, store.files)
        return Seal(store, run_id, authority, place, self.busy.append, self.lines.append)


def test_a_run_is_held_by_one_process_and_let_go_at_the_end(store: Store, run_id: str, protocol: Protocol) -> None:
    with held_run(store, run_id, protocol) as held:
        assert store.driven(run_id)
        held.append(NOTE)
        assert store.events(run_id)[-1].payload == NOTE
        assert store.events(run_id)[-1].actor == "runner"
        with pytest.raises(LeaseHeldError, match="another process drives"), held_run(store, run_id, protocol):
            pass
    assert not store.driven(run_id)
    with held_run(store, run_id, protocol) as again:
        assert again.refresh() == again.state


def test_a_run_is_let_go_when_its_runner_fails(store: Store, run_id: str, protocol: Protocol) -> None:
    with pytest.raises(RuntimeError, match="broken"), held_run(store, run_id, protocol):
        raise RuntimeError("broken")
    assert not store.driven(run_id)


def test_a_seal_signs_the_last_event_and_brings_the_copy_up_to_date(
    store: Store, run_id: str, tmp_path: Path
) -> None:
    told, copy = Told(), tmp_path / "copy.jsonl"
    told.seal(store, run_id, copy=copy).sign(ended=False)
    assert store.checkpoints(run_id)[-1].seq == store.events(run_id)[-1].seq
    assert copy.read_bytes() == (tmp_path / "data" / "signatures.jsonl").read_bytes()
    assert told.busy == ["signing the record"]
    assert told.lines == []


def test_only_the_end_of_a_run_is_stamped_and_a_missing_stamp_is_asked_for_again(store: Store, run_id: str) -> None:
    seal = Told().seal(store, run_id, authority=NOBODY)
    seal.sign(ended=False)
    asked = [event for event in store.events(run_id) if event.payload.kind == "device_trouble"]
    assert asked == []
    seal.sign(ended=True)
    seal.sign_if_missing()
    troubles = [event for event in store.events(run_id) if event.payload.kind == "device_trouble"]
    assert len(troubles) == 2
    assert store.checkpoints(run_id)[-1].seq == troubles[-1].seq


class TestFullDisk:
    """The disk is full when the record is signed."""

    @pytest.fixture
    def disk(self) -> FaultyDisk:
        return FaultyDisk("append", 1, errno.ENOSPC)

    def test_it_is_told_with_the_way_on_and_made_good_later(
        self, store: Store, run_id: str, disk: FaultyDisk
    ) -> None:
        told = Told()
        disk.armed = True
        told.seal(store, run_id).sign(ended=False)
        assert disk.failed
        (line,) = told.lines
        assert line.startswith("the record could not be signed")
        assert f"`orthocapture resume {run_id}` signs it" in line
        disk.mended = True
        told.seal(store, run_id).sign(ended=False)
        assert len(told.lines) == 1
        assert store.checkpoints(run_id)[-1].seq == store.events(run_id)[-1].seq
