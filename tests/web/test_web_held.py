"""The page of a hand-held capture: words, verdicts, hemisphere, and the buttons that release and finish."""

from __future__ import annotations

import dataclasses
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from drivers.photo_watch import PhotoWatch, PhotoWatchConfig
from service.cli.main import app
from service.core.records.run_events import CaptureAsked, DeviceOpened
from tests.support.pages.browsed_run import words
from tests.support.pages.web import Browser, WebSite, password_of, web_site
from tests.support.runs.bench_run import Bench
from tests.support.runs.held_run import left_held_run


@contextmanager
def held_site(folder: Path) -> Generator[tuple[WebSite, Browser, Bench]]:
    """A run with four images, the second one blurred, and the technician who controls it."""
    with web_site(folder) as site, pytest.MonkeyPatch.context() as patch:
        bench = left_held_run(site.begin_run, patch, folder)
        browser = site.browser("technician")
        site.take_control(bench.run_id, browser)
        yield site, browser, bench


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Generator[tuple[WebSite, Browser, Bench]]:
    """A site for tests that leave its run as it is."""
    with held_site(tmp_path_factory.mktemp("held")) as held:
        yield held


@pytest.fixture
def acted_on(tmp_path: Path) -> Generator[tuple[WebSite, Browser, Bench]]:
    """A site for a test that adds to its run."""
    with held_site(tmp_path) as held:
        yield held


def last_answer(bench: Bench) -> Mapping[str, Any]:
    """The worker's answer about the last image."""
    jobs = [job for job in bench.state().steps["capture"].jobs.values() if job.kind == "hand_view"]
    return max(jobs, key=lambda job: job.enqueued_seq).result


def test_the_page_says_where_to_go_and_what_became_of_the_images(
    shown: tuple[WebSite, Browser, Bench],
) -> None:
    _, browser, bench = shown
    answer = browser.get(f"/runs/{bench.run_id}/held")
    assert answer.status_code == 200
    page = words(answer.text)
    last = [line for line in bench.operator.told if line.startswith("next: ")][-1].removeprefix("next: ")
    assert last[1:] in page
    assert "not used blurred" in page
    done = [spot for spot in last_answer(bench)["places"] if spot["done"]]
    assert f"{len(done)} of 7" in page
    assert "Release the shutter" in page
    assert answer.text.count("sym-done") == len(done) >= 2
    assert "way-arrow" in answer.text


@pytest.mark.slow
def test_the_buttons_ask_the_step(acted_on: tuple[WebSite, Browser, Bench]) -> None:
    _, browser, bench = acted_on
    for what in ("release", "finish"):
        answer = browser.send_form(f"/runs/{bench.run_id}/held", step="capture", attempt=1, what=what)
        assert answer.status_code == 303
    assert [asked.what for asked in bench.payloads(CaptureAsked)] == ["release", "finish"]
    assert bench.state().steps["capture"].asked == ("release", "finish")
    typed = ["act", "release", "--data", str(bench.data), "--operator", "Grace", "--password-stdin"]
    secret = password_of("grace") + "\n"
    assert CliRunner().invoke(app, typed, input=secret).exit_code == 0, "and so does the command line"
    assert bench.state().steps["capture"].asked == ("release", "finish", "release")
    refused = CliRunner().invoke(app, [*typed, "--step", "ct"], input=secret)
    assert refused.exit_code == 1
    assert "takes no images now" in refused.output
    assert bench.state().steps["capture"].asked == ("release", "finish", "release")


def test_who_does_not_control_the_run_sees_no_buttons_and_may_not_press_them(
    shown: tuple[WebSite, Browser, Bench],
) -> None:
    site, _, bench = shown
    auditor = site.browser("auditor")
    assert "Release the shutter" not in auditor.get(f"/runs/{bench.run_id}/held").text
    answer = auditor.send_form(f"/runs/{bench.run_id}/held", step="capture", attempt=1, what="release")
    assert answer.status_code == 403
    supervisor = site.browser("supervisor")
    answer = supervisor.send_form(f"/runs/{bench.run_id}/held", step="capture", attempt=1, what="release")
    assert answer.status_code in (403, 409)
    assert bench.payloads(CaptureAsked) == []


def test_a_step_that_takes_no_images_now_refuses(shown: tuple[WebSite, Browser, Bench]) -> None:
    _, browser, bench = shown
    answer = browser.send_form(f"/runs/{bench.run_id}/held", step="capture", attempt=2, what="release")
    assert answer.status_code == 409
    assert bench.payloads(CaptureAsked) == []


def test_parts_of_the_page_come_alone(shown: tuple[WebSite, Browser, Bench]) -> None:
    _, browser, bench = shown
    answer = browser.get(f"/runs/{bench.run_id}/held/parts/way,overlay,image,plan")
    assert answer.status_code == 200
    assert answer.text.count("<template") == 4


@pytest.mark.slow
def test_an_image_that_could_not_be_looked_at_says_why_and_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with web_site(tmp_path) as site:
        bench = left_held_run(site.begin_run, monkeypatch, tmp_path, {4: "fails"})
        page = words(site.browser("technician").get(f"/runs/{bench.run_id}/held").text)
        assert "H_004 could not be analysed: the image cannot be decoded" in page
        assert "take it again from the same place" in page


@pytest.mark.slow
def test_a_camera_without_a_cable_has_no_release_and_no_live_view_on_the_page(
    acted_on: tuple[WebSite, Browser, Bench],
) -> None:
    _, browser, bench = acted_on
    page = f"/runs/{bench.run_id}/held"
    assert "Start live view" in browser.get(page).text
    watch = PhotoWatch(PhotoWatchConfig(folder=bench.data / "card"))
    watch.open()
    opened = DeviceOpened(device="camera", report=dataclasses.asdict(watch.report()))
    bench.store.record(bench.run_id, [opened], actor="runner")
    shown_now = browser.get(page).text
    assert "Release the shutter" not in shown_now
    assert "Start live view" not in shown_now
    assert "That is enough" in shown_now
    assert f"as soon as their files are in {bench.data / 'card'}" in words(shown_now)
