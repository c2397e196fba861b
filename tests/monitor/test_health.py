"""`/health` and `/metrics`: consistent with the data folder, restricted to permitted clients, and bounded labels."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Generator
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from service.core.records.run_events import DeviceOpened, DeviceTrouble
from service.monitor.snapshot import Snapshot, write_snapshot
from service.store.durable_effects import SystemClock
from service.store.records import NewJob
from tests.support.pages.web import HOST, Browser, WebSite, web_site
from tests.support.processes.forked import Forked
from tests.support.processes.waiting import until
from tests.support.record.store import enqueue
from tests.support.runs.bench_run import Bench


@pytest.fixture
def site(tmp_path: Path) -> Generator[WebSite]:
    with web_site(tmp_path) as site:
        yield site


def of_this_machine(site: WebSite, address: str = "127.0.0.1") -> Browser:
    """A program that has not signed in."""
    browser = Browser(site.app, base_url=HOST, client=(address, 50000))
    browser.site = site.site
    site.browsers.append(browser)
    return browser


def scrape(site: WebSite) -> dict[str, dict[tuple[str, ...], float]]:
    """Value by name and labels (sorted by name), parsed with Prometheus' own parser."""
    answer = of_this_machine(site).get("/metrics")
    assert answer.status_code == 200, answer.text
    found: dict[str, dict[tuple[str, ...], float]] = {}
    for family in text_string_to_metric_families(answer.text):
        for sample in family.samples:
            found.setdefault(sample.name, {})[tuple(value for _, value in sorted(sample.labels.items()))] = (
                sample.value
            )
    return found


def let_wait(site: WebSite, bench: Bench) -> None:
    job = NewJob("locate_spheres", "fixation", 1, "key", {"mesh": "0" * 64, "radius_m": 0.015, "expected": 10})
    enqueue(site.store, bench.run_id, job, actor="test")


def test_a_healthy_site_says_so_to_anybody_and_nothing_more(site: WebSite) -> None:
    run_id = site.record_run()
    answer = site.browser().get("/health")
    assert answer.status_code == 200
    whole = {"ok": True, "what": ""}
    parts = ("database", "data_folder", "worker", "runners", "second_place")
    assert answer.json() == {"ok": True} | dict.fromkeys(parts, whole)
    assert run_id not in answer.text


@pytest.fixture
def site_of_the_host(tmp_path: Path) -> Generator[WebSite]:
    """A site that goes by the host's clock, as a worker beside it does."""
    with web_site(tmp_path, clock=SystemClock()) as site:
        yield site


def test_a_job_without_a_worker_is_not_healthy_until_one_lives(site_of_the_host: WebSite) -> None:
    site = site_of_the_host
    let_wait(site, site.begin_run())
    answer = site.browser().get("/health")
    assert (answer.status_code, answer.json()["worker"]["what"]) == (503, "a job waits, and no worker is running")
    # In an empty folder beside it: the worker has nothing to do and stays alive.
    words = [sys.executable, "-m", "service.cli.main", "worker", "--data", str(site.site.data), "--json"]
    with Forked(words, stdout=subprocess.DEVNULL) as worker:
        try:
            until(lambda: scrape(site)["orthocapture_workers"][()] >= 1, "no worker shows")
            assert site.browser().get("/health").json()["worker"]["ok"]
        finally:
            worker.kill()  # so that it can no longer remove its heartbeat file
            worker.wait()
    assert scrape(site)["orthocapture_workers"][()] == 0


def test_a_silent_runner_is_not_healthy(site: WebSite) -> None:
    bench = site.begin_run()
    with site.store.lease(bench.run_id, "runner", 30.0):
        write_snapshot(site.site.data, bench.run_id, Snapshot(at_utc_s=site.now_utc_s, pid=1, doing="working"))
        assert site.browser().get("/health").status_code == 200
        write_snapshot(site.site.data, bench.run_id, Snapshot(at_utc_s=site.now_utc_s - 90, pid=1, doing="working"))
        answer = site.browser().get("/health")
        assert (answer.status_code, answer.json()["runners"]["ok"]) == (503, False)
        silent = scrape(site)["orthocapture_runner_silent_seconds"]
        assert silent[(bench.run_id,)] == pytest.approx(90, abs=20)


def test_a_database_that_was_moved_away_is_not_healthy(site: WebSite) -> None:
    path = site.store.database_path
    path.rename(path.with_suffix(".away"))
    answer = site.browser().get("/health")
    assert (answer.status_code, answer.json()["database"]["ok"]) == (503, False)
    assert str(path.parent) not in answer.text
    assert scrape(site)["orthocapture_healthy"][("database",)] == 0


def test_the_figures_are_those_of_the_record(site: WebSite) -> None:
    site.record_run()
    bench = site.begin_run()
    let_wait(site, bench)
    report = {"identity": {"kind": "camera"}, "clock_offset_s": -2.5, "problems": ["the battery is low"]}
    site.store.record(bench.run_id, [DeviceOpened(device="camera", report=report)], actor="runner")
    found = scrape(site)
    assert found["orthocapture_runs"] == {("completed",): 1, ("aborted",): 0, ("open",): 1}
    assert found["orthocapture_captures_total"] == {(): 4}
    assert found["orthocapture_jobs"] == {("locate_spheres", "queued"): 1}
    assert found["orthocapture_queue_length"] == {("waited",): 1, ("background",): 0}
    assert found["orthocapture_database_bytes"][()] > 100_000
    assert found["orthocapture_free_bytes"][()] > 0
    of_camera = ("camera", "camera", bench.run_id)
    assert found["orthocapture_clock_offset_seconds"][("host UTC", "camera", bench.run_id)] == -2.5
    assert found["orthocapture_clock_within_limit"][("camera", bench.run_id)] == 1
    assert found["orthocapture_device_problems"] == {of_camera: 1}
    assert found["orthocapture_device_up"] == {of_camera: 1}
    trouble = DeviceTrouble(device="camera", error="DeviceUnavailableError", message="it is gone")
    site.store.record(bench.run_id, [trouble], actor="runner")
    assert scrape(site)["orthocapture_device_up"] == {of_camera: 0}


def test_a_run_that_is_driven_shows_its_pace_and_its_arm(site: WebSite) -> None:
    run_id = site.record_run()
    with site.store.lease(run_id, "runner", 30.0):
        write_snapshot(
            site.site.data, run_id, Snapshot(at_utc_s=site.now_utc_s, pid=1, doing="working", robot="moving")
        )
        found = scrape(site)
    assert found["orthocapture_driven_runs"] == {(): 1}
    assert found["orthocapture_robot_state"] == {(run_id, "moving"): 1}
    assert 0 < found["orthocapture_viewpoint_seconds"][(run_id,)] < 60


def test_a_finished_job_tells_how_long_it_took(site: WebSite) -> None:
    bench = site.begin_run()
    let_wait(site, bench)
    job = site.store.claim_job("worker", 30)
    assert job is not None
    site.store.finish_job(job, measures={}, duration_s=0.0)
    found = scrape(site)
    assert found["orthocapture_job_seconds_count"] == {("locate_spheres",): 1}
    assert 0 <= found["orthocapture_job_seconds_sum"][("locate_spheres",)] < 30
    assert found["orthocapture_jobs"] == {("locate_spheres", "finished"): 1}


def test_metrics_are_for_this_machine_and_for_readers(site: WebSite) -> None:
    for address in ("127.0.0.1", "127.0.0.9", "::1"):
        assert of_this_machine(site, address).get("/metrics").status_code == 200
    stranger = of_this_machine(site, "192.168.1.20")
    assert stranger.get("/metrics", headers={"accept": "application/json"}).status_code == 401
    for header in ("x-forwarded-for", "forwarded", "via"):  # a proxy on this machine forwards somebody else's request
        answer = of_this_machine(site).get("/metrics", headers={header: "127.0.0.1", "accept": "application/json"})
        assert answer.status_code == 401
    assert site.browser("auditor").get("/metrics").status_code == 200


def test_requests_are_counted_by_route_and_never_by_what_a_stranger_types(site: WebSite) -> None:
    run_id = site.record_run()
    browser = site.browser("auditor")
    assert browser.get(f"/runs/{run_id}").status_code == 200
    for number in range(3):
        assert browser.get(f"/nowhere-{number}").status_code == 404
        browser.request(f"VERB{number}", "/health")
    found = scrape(site)["orthocapture_web_requests_total"]
    assert found[("GET", "/runs/{run_id}", "200")] == 1
    assert found[("GET", "other", "404")] == 3
    assert not [labels for labels in found if "nowhere" in "".join(labels) or "VERB" in "".join(labels)]
