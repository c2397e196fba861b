"""The overview of a run: accuracy with limits, all gates, times of the site, verifications made elsewhere."""

from __future__ import annotations

import re
import time
from collections.abc import Generator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.audit.devices import clock_offsets
from service.cli.main import app
from service.core.measure_names import measure_name
from service.core.records.run_events import FilesKept, SessionStarted, StepStarted
from service.core.words import local_time
from service.steps import step_kinds
from service.store.records import NewArtefact
from service.store.store import Store
from service.web.run_frame import sentence
from tests.support.pages.browsed_run import words
from tests.support.pages.web import WebSite, web_site
from tests.support.processes.waiting import until
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import captured, put_image, start_run
from tests.support.recorded.reported_run import record_reported_run


@pytest.fixture
def web(tmp_path: Path) -> Generator[tuple[WebSite, str]]:
    run_id = record_reported_run(tmp_path, person="grace")
    with web_site(tmp_path) as site:
        yield site, run_id


def read(web: tuple[WebSite, str], page: str = "") -> str:
    """A page of the run's audit, once its background computation is ready."""
    site, run_id = web
    browser, text = site.browser("auditor"), ""

    def computed() -> bool:
        nonlocal text
        answer = browser.get(f"/audit/runs/{run_id}{page}")
        assert answer.status_code == 200, answer.text
        text = answer.text
        return "Being computed" not in text

    until(computed, "the page is still being computed", every_s=0.05)
    return words(text)


def test_the_accuracy_stands_beside_its_limit_and_what_is_exported(web: tuple[WebSite, str]) -> None:
    page = read(web)
    assert "Overview" in page
    assert "First page" not in page
    table = page[page.index("Accuracy on the control spheres") : page.index("All gates")]
    assert "at most 0.35 mm" in table
    assert "Within" in table
    assert table.count("These poses would be exported") == 1


def test_an_error_beyond_the_limit_is_outside(tmp_path: Path) -> None:
    run_id = record_reported_run(tmp_path, error_mm=0.9, person="grace")
    with web_site(tmp_path) as site:
        page = read((site, run_id))
    table = page[page.index("Accuracy on the control spheres") : page.index("All gates")]
    assert re.search(r"0\.900 mm at most 0\.35 mm Outside", table)


def test_all_gates_have_a_page(web: tuple[WebSite, str]) -> None:
    site, run_id = web
    page = read(web, "/gates")
    log = site.site.run(run_id)
    gates = [gate for step in log.protocol.steps for gate in step.gates]
    assert gates
    assert page.count("Within") + page.count("Outside") + page.count("Not yet") >= len(gates)
    declared = {name: kind.measures.declared() for name, kind in step_kinds().items()}
    explained = 0
    for step in log.protocol.steps:
        assert not step.gates or step.title in page
        for gate in step.gates:
            assert measure_name(gate.measure) in page
            measure = declared[step.kind].get(gate.measure)
            if measure is not None and not gate.why:
                assert sentence(measure.meaning) in page, "a limit without a reason says what its measure means"
                explained += 1
    assert explained


def test_a_verification_in_the_terminal_is_known_to_the_page(web: tuple[WebSite, str]) -> None:
    site, run_id = web
    assert "Not verified yet" in read(web)
    answer = CliRunner().invoke(app, ["audit", "verify", run_id, "--data", str(site.site.data)])
    assert answer.exit_code == 0, answer.output
    page = read(web)
    assert "Verifies" in page
    assert "(command line)" in page


def test_files_kept_one_after_the_other_are_one_line(web: tuple[WebSite, str]) -> None:
    site, _ = web
    run_id = site.begin_run().run_id
    site.store.record(run_id, [StepStarted(step="fixation", attempt=1)], actor="runner")
    for i in range(4):
        ref = site.store.put_bytes(bytes([i]), kind="ct", media_type="application/dicom", original_name=f"{i}.dcm")
        kept = FilesKept(step="fixation", attempt=1, device="ct", note="as it came", artefacts=(ref,))
        row = NewArtefact(ref, "ct", "fixation", 1)
        site.store.record(run_id, [kept], actor="runner", artefacts=[row])
    page = read((site, run_id), "/timeline")
    assert "4 files one after the other" in page
    html = site.browser("auditor").get(f"/audit/runs/{run_id}/timeline").text
    assert html.count('class="folded"') == 1
    assert html.count("<ol") == html.count("</ol>")
    assert len(re.findall(r'<li id="event-\d+"', html)) == site.store.head(run_id)


def test_a_time_is_told_on_the_sites_clock_too(monkeypatch: pytest.MonkeyPatch) -> None:
    try:
        monkeypatch.setenv("TZ", "Europe/Zurich")
        time.tzset()
        assert local_time("2026-11-22T20:35:05.123456Z") == "21:35:05 CET"
        assert local_time("2026-07-22T23:35:05Z") == "2026-07-23 01:35:05 CEST"
        assert local_time("not a time") == ""
        monkeypatch.setenv("TZ", "UTC")
        time.tzset()
        assert local_time("2026-11-22T20:35:05Z") == ""
    finally:
        monkeypatch.undo()
        time.tzset()


PTP, EXIF = "3282933005318008", "05318008"


def test_one_camera_has_one_serial_number(tmp_path: Path) -> None:
    run_id = record_reported_run(tmp_path, person="grace", serials=(PTP, EXIF))
    with web_site(tmp_path) as site:
        overview, devices = read((site, run_id)), read((site, run_id), "/devices")
        html = words(site.browser("auditor").get(f"/audit/runs/{run_id}/devices").text)
    assert f"ILCE-7RM5 {EXIF}" in overview
    assert PTP not in overview
    assert devices.count(PTP) == 1
    assert (
        f"Over its connection it states {PTP}, which ends with the same digits: it is one and the same body" in html
    )


def test_photographs_of_another_body_are_told(tmp_path: Path) -> None:
    run_id = record_reported_run(tmp_path, person="grace", serials=(PTP, "77"))
    with web_site(tmp_path) as site:
        devices = read((site, run_id), "/devices")
    assert (
        f"Photographs state the serial number 77, and no camera that was opened does: camera states {PTP}" in devices
    )


def test_photographs_taken_again_and_exposures_that_failed_are_counted(web: tuple[WebSite, str]) -> None:
    page = read(web)
    table = page[page.index("Views given up") : page.index("What was taken again")]
    assert "Capture the specimen 3 2 1 1 0" in table
    assert "1 Re-do 1 Skipped view 0 Skipped steps" in page
    assert "1 Correction " in page


def test_what_a_clock_offset_means_stands_beside_it(tmp_path: Path) -> None:
    run_id = record_reported_run(tmp_path, person="grace", serials=(PTP, EXIF))
    with web_site(tmp_path) as site:
        page = read((site, run_id), "/devices")
    assert "counts from when it was switched on: only its drift matters" in page
    assert "1279.000 s behind this machine's" in page
    assert "Beyond It sets the times in the device's own files. Order and times of the record do not depend" in page
    assert "a large or negative value is not a fault" in page


def test_the_clocks_of_a_step_are_compared_within_one_start_of_the_program(tmp_path: Path) -> None:
    """The host's monotonic clock begins anew with a boot: over it, neither drift nor duration means anything."""
    clock = SteppedClock()
    with Store.open(tmp_path, clock) as store:
        run = start_run(store)
        for start in (1, 2):
            store.record(run, [SessionStarted(resumed=start > 1, software={}, host="h", pid=start)], actor="runner")
            for number in (1, 2):
                clock.passed_s += 10.0
                ref = put_image(store, f"v{start}_{number}")
                offset_s = 5000.0 - clock.monotonic_s() + clock.passed_s + 0.001 * number
                view = captured(ref, f"v{start}_{number}", clock_offset_s=offset_s)
                store.record(run, [view], actor="camera", artefacts=[NewArtefact(ref, "camera")])
            clock.reboot(600.0)
        with store.database.reading() as connection:
            series = clock_offsets(connection, run)
    assert [(one.start, one.captures, one.over_s) for one in series] == [(1, 2, 10.0), (2, 2, 10.0)]
    assert [one.drift_s for one in series] == pytest.approx([0.001, 0.001])
