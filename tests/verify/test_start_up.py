"""The start-up log: differences, clock jumps, unfinished work, and chain ends that may not move back."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from service.core.errors import ConfigurationError
from service.core.records.events import ServiceStarted
from service.core.records.run_events import RunAborted
from service.rig import Rig, load_rig
from service.store.records import SITE
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification.verify import verify
from service.web import site
from service.web.site import record_start
from tests.support.record.outsider import tamper
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import CountedIds, capture, start_run


class Clocks(SteppedClock):
    """The host's UTC can be set; its monotonic clock cannot."""

    set_s = 0.0

    def monotonic_s(self) -> float:
        return super().monotonic_s() - self.set_s


@pytest.fixture
def clock() -> Clocks:
    return Clocks()


@pytest.fixture
def store(tmp_path: Path, clock: Clocks) -> Iterator[Store]:
    with Store.open(tmp_path / "data", clock, CountedIds()) as opened:
        yield opened


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    path = tmp_path / "rig.yaml"
    path.write_text("name: r\nsimulated: true\ndevices: {}\n")
    return load_rig(path)


@pytest.fixture
def protocol(tmp_path: Path) -> Path:
    path = tmp_path / "p.yaml"
    path.write_text("id: p\n")
    return path


def test_differences_since_the_last_start_are_told(
    store: Store, rig: Rig, protocol: Path, clock: Clocks, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(site, "software_versions", lambda: {"a": "1", "b": "1"})
    first = record_start(store, rig, [protocol], "http://127.0.0.1:8000")
    assert (first.changed, first.clock_jump_s) == ({}, None)
    assert first.configuration.keys() == {str(rig.path), str(protocol)}
    clock.passed_s = 100.0
    monkeypatch.setattr(site, "software_versions", lambda: {"a": "2", "c": "1"})
    protocol.write_text("id: other\n")
    second = record_start(store, rig, [protocol], "http://127.0.0.1:8000")
    assert second.changed == {
        "a": ("1", "2"),
        "b": ("1", ""),
        "c": ("", "1"),
        str(protocol): (first.configuration[str(protocol)], second.configuration[str(protocol)]),
    }
    assert second.clock_jump_s == 0.0
    clock.passed_s, clock.set_s = 100.0 - 3600.0 + 7.0, -3600.0  # somebody set the clock back by an hour
    assert record_start(store, rig, [], "x").clock_jump_s == -3600.0
    assert [event.payload.kind for event in store.events(SITE)] == ["site_opened", *["service_started"] * 3]
    protocol.unlink()
    with pytest.raises(ConfigurationError, match="cannot be read"):
        record_start(store, rig, [protocol], "x")


def test_after_a_reboot_a_clock_jump_cannot_be_told(store: Store, rig: Rig) -> None:
    record_start(store, rig, [], "x")
    with store.database.writing() as connection:
        last = store.events(SITE)[-1].payload
        assert isinstance(last, ServiceStarted)
        store.append_site(connection, [last.model_copy(update={"boot": "another"})], actor="service")
    assert record_start(store, rig, [], "x").clock_jump_s is None


def test_open_and_unsigned_runs_are_told(store: Store, rig: Rig) -> None:
    assert record_start(store, rig, [], "x").heads == {}
    ended, running = start_run(store), start_run(store)
    store.record(ended, [RunAborted(reason="x")], actor="ada")
    checkpoint(store, ended)
    told = record_start(store, rig, [], "x")
    assert (told.open_runs, told.unsigned_runs) == ((running,), (running,))
    assert told.heads == {
        run: (event.seq, event.sha256) for run in (ended, running) for event in store.events(run)[-1:]
    }
    capture(store, running, "v1")
    assert set(record_start(store, rig, [], "x").heads) == {running}


def test_a_run_cut_back_with_its_checkpoints_is_found(store: Store, rig: Rig) -> None:
    run = start_run(store)
    capture(store, run, "v1")
    checkpoint(store, run)
    capture(store, run, "v2")
    checkpoint(store, run)
    record_start(store, rig, [], "x")
    checkpoint(store, SITE)
    data = store.database_path.parent
    assert verify(data).faults == ()
    where = f"run_id = '{run}' AND seq = 3"
    tamper(
        data,
        *(f"DELETE FROM {table} WHERE {where}" for table in ("checkpoints", "artefacts", "events")),
        f"UPDATE heads SET seq = 2, sha256 = (SELECT sha256 FROM events WHERE run_id = '{run}' AND seq = 2) "
        f"WHERE run_id = '{run}'",
    )
    found = verify(data, run).faults
    assert {fault.seq for fault in found if fault.run_id == run} == {3}
    assert any("the chain was cut or rewritten since" in fault.what for fault in found)
