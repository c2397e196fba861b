"""Clocks: every known offset of a run is recorded, shown and scraped, and reported when it exceeds its limit."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from datetime import UTC, timedelta
from pathlib import Path

import pytest

from drivers.interfaces import DeviceReport
from service.core.recorded_devices import ClockReading, clock_readings
from service.core.records.events import Payload
from service.core.records.run_events import DeviceOpened, HostClock, SessionStarted
from service.monitor.reporter import host_clock
from service.store.records import NewArtefact
from service.store.store import Store
from tests.support.pages.web import web_site
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import captured, put_image, start_run
from tests.support.runs.bench_run import PROTOCOL, begin_run

_CHRONY = """#!/bin/sh
[ "$1 $2" = "-n tracking" ] || exit 3
cat <<END
Reference ID    : C0A80101 (192.168.1.1)
Stratum         : 3
Ref time (UTC)  : Sun Nov 22 18:00:00 2026
System time     : 1.250000000 seconds {way} of NTP time
Last offset     : -0.000000011 seconds
Leap status     : {leap}
END
exit {status}
"""


def opened(device: str, kind: str, offset_s: float | None, **more: object) -> DeviceOpened:
    report = {"identity": {"kind": kind}, "clock_offset_s": offset_s, **more}
    return DeviceOpened(device=device, report=report)


def readings(tmp_path: Path, *payloads: Payload | tuple[float, Payload]) -> dict[str, ClockReading]:
    """The clock readings of a run with these events; a number before an event is a wait (s)."""
    clock = SteppedClock()
    with Store.open(tmp_path / "data", clock) as store:
        run_id = start_run(store)
        for one in payloads:
            wait_s, payload = one if isinstance(one, tuple) else (0.0, one)
            clock.passed_s += wait_s
            store.record(run_id, [payload], actor="runner")
        return {reading.device: reading for reading in clock_readings(store.events(run_id))}


def test_a_devices_utc_clock_is_held_against_the_host(tmp_path: Path) -> None:
    found = readings(tmp_path, opened("camera", "camera", -3.0), opened("box", "lightbox", 7.5))
    assert (found["camera"].offset_s, found["camera"].within) == (-3.0, True)
    assert found["box"].within is False
    assert found["box"].words.startswith("The clock of box is 7.50 s ahead of this machine's: more than 5 s. Set it")


def test_a_clock_that_counts_from_power_on_counts_by_its_change_alone(tmp_path: Path) -> None:
    clock = SteppedClock()
    with Store.open(tmp_path / "data", clock) as store:
        run_id = start_run(store)

        def capture(viewpoint: str, offset_s: float) -> ClockReading:
            ref = put_image(store, viewpoint)
            event = captured(ref, viewpoint, clock_offset_s=offset_s, trigger_monotonic_s=clock.monotonic_s())
            store.record(run_id, [event], actor="camera", artefacts=[NewArtefact(ref, "camera")])
            return {reading.device: reading for reading in clock_readings(store.events(run_id))}["robot"]

        store.record(run_id, [opened("robot", "robot", -23048.9, clock="uptime")], actor="runner")
        assert capture("v1", -23048.9).within is True
        clock.passed_s += 10
        assert capture("v2", -23048.88).within is True
        late = capture("v3", -23048.4)
        assert late.within is False
        assert late.offset_s == pytest.approx(0.5)
        # After reopening it counts from zero: the controller was switched off and on.
        store.record(run_id, [opened("robot", "robot", 12.0, clock="uptime")], actor="runner")
        assert capture("v4", 12.0).offset_s == 0.0


def test_the_cameras_clock_is_that_of_its_images(tmp_path: Path) -> None:
    clock = SteppedClock()
    with Store.open(tmp_path / "data", clock) as store:
        run_id = start_run(store)
        store.record(run_id, [opened("camera", "camera", None)], actor="runner")
        ref = put_image(store, "v1")
        clock.passed_s += 2.0  # from the release to the record
        released = clock.utc_now() - timedelta(seconds=2.0)
        ahead = (released + timedelta(seconds=40)).astimezone(UTC)
        camera = {"iso": 100, "exif_time": f"{ahead:%Y:%m:%d %H:%M:%S}.00+00:00"}
        event = captured(ref, "v1", camera=camera, trigger_monotonic_s=clock.monotonic_s() - 2.0)
        store.record(run_id, [event], actor="camera", artefacts=[NewArtefact(ref, "camera")])
        found = {reading.device: reading for reading in clock_readings(store.events(run_id))}
    assert found["camera"].offset_s == pytest.approx(40, abs=1.0)
    assert found["camera"].within is False


def session(clock: HostClock | None) -> SessionStarted:
    return SessionStarted(resumed=False, software={}, host="here", pid=1, host_clock=clock)


def test_the_hosts_clock_is_held_against_the_network(tmp_path: Path) -> None:
    found = readings(tmp_path, session(HostClock(source="chrony", synchronised=True, offset_s=-1.5)))
    assert found["host"].within is False
    assert "is 1.50 s behind the network's" in found["host"].words
    unknown = readings(tmp_path / "b", session(HostClock(source="kernel", synchronised=False, offset_s=None)))
    assert (unknown["host"].within, unknown["host"].note) == (None, "not set by the network")


@pytest.fixture
def chrony(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """A chronyc that prints what it is told to."""
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin:/usr/bin")

    def says(way: str, leap: str = "Normal", status: int = 0) -> None:
        (tmp_path / "chronyc").write_text(_CHRONY.format(way=way, leap=leap, status=status))
        (tmp_path / "chronyc").chmod(0o755)

    return says


def test_chrony_is_asked(chrony: Callable[..., None]) -> None:
    chrony("fast")
    assert host_clock() == HostClock(source="chrony", synchronised=True, offset_s=1.25)
    chrony("slow")
    assert host_clock().offset_s == -1.25
    chrony("slow", leap="Not synchronised")
    assert host_clock() == HostClock(source="chrony", synchronised=False, offset_s=None)
    chrony("slow", status=1)  # it is not running: the kernel is asked
    assert host_clock().source == "kernel"


def test_a_run_records_tells_and_shows_its_clocks(
    tmp_path: Path, chrony: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    chrony("slow")
    with web_site(tmp_path) as site:
        bench = begin_run(site.store, PROTOCOL, tmp_path)
        report = bench.rig.shutter.report

        def late() -> DeviceReport:
            return dataclasses.replace(report(), clock_offset_s=-90.0)

        monkeypatch.setattr(bench.rig.shutter, "report", late)
        assert bench.run().status == "completed"
        told = [words for words in bench.operator.told if words.startswith("The clock of")]
        assert len(told) == 2
        assert "The clock of this machine is 1.25 s behind the network's: more than 1 s" in told[0]
        assert "The clock of camera is 90.00 s behind this machine's: more than 5 s" in told[1]
        (begun,) = bench.payloads(SessionStarted)
        assert begun.host_clock == HostClock(source="chrony", synchronised=True, offset_s=-1.25)
        auditor = site.browser("auditor")
        page = auditor.get(f"/audit/runs/{bench.run_id}/devices").text
        assert "90.000 s behind" in page
        assert "1.250 s behind" in page
        assert page.count("Beyond") == 2
        scraped = auditor.get("/metrics").text
        labels = f'{{against="host UTC",device="camera",run="{bench.run_id}"}}'
        assert f"orthocapture_clock_offset_seconds{labels} -90.0" in scraped
        bench.must_verify()
        begun_run = begin_run(site.store, PROTOCOL, tmp_path)
        site.store.record(begun_run.run_id, [opened("camera", "camera", -90.0)], actor="runner")
        page = auditor.get(f"/runs/{begun_run.run_id}").text
        assert "Clock of camera" in page
        assert "90.000 s behind" in page
