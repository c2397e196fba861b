"""Disk space: forecast from plan and past use, stated before a run, and asked about before it runs out."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Generator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.core.disk_space import LEAST_FREE_BYTES, Usage, forecast
from service.core.errors import SpaceShortError
from service.core.protocol import Protocol, parse_protocol
from service.core.records.run_events import OperatorAction, StepFailed, StepNote
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.rig import load_rig
from service.run_start import start_run
from service.steps import params_models
from service.store.disk_space import forecast_of
from service.store.records import NewJob
from service.worker.loop import work
from tests.support.pages.web import web_site
from tests.support.record.store import enqueue
from tests.support.runs.bench_run import PROTOCOL, Bench, begin_run, bench_store

GB = 10**9
SetFree = Callable[[int], None]


@pytest.fixture
def set_free(monkeypatch: pytest.MonkeyPatch) -> SetFree:
    """A disk with this much free space."""
    usage = shutil.disk_usage("/")
    free = [100 * GB]
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: usage._replace(free=free[0]))

    def set_to(free_bytes: int) -> None:
        free[0] = free_bytes

    return set_to


@pytest.fixture
def bench(tmp_path: Path, set_free: SetFree) -> Generator[Bench]:
    set_free(100 * GB)
    with bench_store(tmp_path / "data") as store:
        yield begin_run(store, PROTOCOL, tmp_path)


def protocol(views: int) -> Protocol:
    text = PROTOCOL.replace("count: 4", f"count: {views}")
    return parse_protocol(text.encode(), params_models(), name="p.yaml").protocol


def test_the_forecast_is_planned_views_times_what_views_have_taken() -> None:
    before = Usage(views=100, view_bytes=100 * 60_000_000, computed_bytes=100 * 5_000_000, other_bytes=2 * GB)
    found = forecast(protocol(100), None, Usage(), before, 100 * GB, simulated=False)
    assert (found.views_left, found.view_bytes, found.known_from) == (100, 65_000_000, "an earlier run")
    assert found.needed_bytes == 100 * 65_000_000 + 2 * GB
    assert found.verdict == "enough"
    # By its own figures as soon as it has some; its jobs' pending output is added.
    here = Usage(views=10, view_bytes=10 * 80_000_000, computed_bytes=0, other_bytes=0)
    found = forecast(protocol(100), None, here, before, 100 * GB, simulated=False)
    assert found.known_from == "this run"
    assert found.needed_bytes == 100 * 80_000_000 + 110 * 5_000_000 + 2 * GB


def test_the_verdict_at_the_edges() -> None:
    before = Usage(views=100, view_bytes=100 * 60_000_000)

    def verdict(free_bytes: int) -> str:
        return forecast(protocol(100), None, Usage(), before, free_bytes, simulated=False).verdict

    assert verdict(LEAST_FREE_BYTES + 6 * GB) == "enough"
    assert verdict(LEAST_FREE_BYTES + 6 * GB - 1) == "short"
    assert verdict(LEAST_FREE_BYTES + 300_000_000) == "short"
    assert verdict(LEAST_FREE_BYTES + 300_000_000 - 1) == "stop"


def test_without_any_figures_it_says_that_it_guesses() -> None:
    found = forecast(protocol(108), None, Usage(), None, 5 * GB, simulated=False)
    assert (found.known_from, found.verdict) == ("a guess", "short")
    assert "from a guess" in found.words
    assert "5.0 GB are free, and the run needs about 11.8 GB more (108 views of 100 MB each" in found.words


def test_a_run_pauses_with_a_question_before_the_disk_is_full_and_goes_on(bench: Bench, set_free: SetFree) -> None:
    (bench.data / "exports").mkdir()
    (bench.data / "exports" / "bundle.zip").write_bytes(b"0" * 3_000_000)
    asked: list[str] = []

    def fill(number: int) -> None:
        if number == 2:
            set_free(LEAST_FREE_BYTES + 100)
        bench.clock.passed_s += 3  # the disk is checked every two seconds

    def answer(question: AskOperator, _state: RunState) -> OperatorAction | None:
        asked.append(question.text)
        assert len(bench.captured()) == 2  # no exposure was begun that could not have been recorded
        set_free(100 * GB)
        return OperatorAction(action="confirm", step="capture")

    bench.rig.shutter.on_capture = fill
    bench.script("capture", "recovery", answer)
    assert bench.run().status == "completed"
    (failed,) = bench.payloads(StepFailed)
    assert (failed.error, failed.recovery) == ("SpaceShortError", "ask")
    assert "The disk of the data folder is nearly full" in asked[0]
    assert "exports that were copied elsewhere: 3 MB" in asked[0]
    assert "the last 1.1 GB are kept free, so that work under way can be recorded" in asked[0]
    needed = re.search(r"Nothing begins until (\d+\.\d) GB are free", asked[0])
    assert needed is not None
    assert float(needed[1]) + 0.05 >= LEAST_FREE_BYTES / GB
    assert len(set(bench.captured())) == len(bench.captured()) == 4
    (note,) = [note.data for note in bench.payloads(StepNote) if note.note == "disk_space"]
    assert (note["verdict"], note["free_bytes"]) == ("stop", LEAST_FREE_BYTES + 100)
    bench.must_verify()


def test_a_run_that_will_not_fit_says_so_once_with_the_figures(tmp_path: Path, set_free: SetFree) -> None:
    with bench_store(tmp_path / "data") as store:
        set_free(LEAST_FREE_BYTES + 30_000_000)  # for 20 views of a simulated rig, estimated at 4 MB
        bench = begin_run(store, PROTOCOL.replace("count: 4", "count: 20"), tmp_path)
        assert bench.run().status == "completed"  # they are smaller than estimated
        notes = [note.data for note in bench.payloads(StepNote) if note.note == "disk_space"]
        assert [(note["verdict"], note["views_left"]) for note in notes] == [("short", 20)]
        (told,) = [words for words in bench.operator.told if "The disk is too small" in words]
        assert "the last 1.1 GB are kept free" in told
        assert "the run needs about 80 MB more (20 views of 4 MB each, from a guess)" in told


def test_a_run_is_refused_where_nothing_could_be_captured(tmp_path: Path, bench: Bench, set_free: SetFree) -> None:
    set_free(LEAST_FREE_BYTES // 2)
    loaded = parse_protocol(PROTOCOL.encode(), params_models(), name="bench.yaml")
    before = len(bench.store.runs())
    with pytest.raises(SpaceShortError, match="nearly full"):
        start_run(bench.store, loaded, load_rig(tmp_path / "rig.yaml"), operator="Ada", auto_confirm=False)
    assert len(bench.store.runs()) == before


def test_an_earlier_run_of_the_protocol_gives_the_figures(bench: Bench) -> None:
    bench.run()
    found = forecast_of(bench.store, protocol(4), simulated=True)
    images = [row.ref.size_bytes for row in bench.store.artefacts(bench.run_id) if row.viewpoint is not None]
    assert found.known_from == "an earlier run"
    assert found.view_bytes == pytest.approx(sum(images) / 4, abs=1)
    assert forecast_of(bench.store, protocol(4), bench.state()).needed_bytes == 0  # it has ended


def test_doctor_and_pages_say_it_before_a_run(tmp_path: Path, set_free: SetFree) -> None:
    set_free(2 * GB)
    with web_site(tmp_path) as site:
        text = PROTOCOL.replace("count: 4", "count: 1000")
        (site.site.protocols / "large.yaml").write_text(text)
        page = site.browser("technician").get("/").text
        assert page.count("The disk is too small") == 1
        bench = site.begin_run()
        page = site.browser("technician").get(f"/runs/{bench.run_id}").text
        assert "2.0 GB free" in page
        assert "16 MB to come" in page
    words = ["doctor", "--rig", str(tmp_path / "rig.yaml"), "--data", str(tmp_path / "data")]
    words += ["--protocol", str(tmp_path / "protocols" / "large.yaml")]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 1
    assert "The disk is too small: 2.0 GB are free, and the run needs about 4.0 GB more" in done.stdout
    found = json.loads(CliRunner().invoke(app, [*words, "--json"]).stdout)["data"]["forecast"]
    assert (found["verdict"], found["views_left"]) == ("short", 1000)


def test_an_export_leaves_the_evidence_its_room(bench: Bench, tmp_path: Path, set_free: SetFree) -> None:
    bench.run()
    set_free(LEAST_FREE_BYTES + 100)
    words = ["audit", "export", bench.run_id, str(tmp_path / "b.zip"), "--data", str(bench.data), "--json"]
    refused = CliRunner().invoke(app, words)
    assert refused.exit_code == 1
    assert "this export needs about" in json.loads(refused.stdout)["error"]["what"]
    assert list(tmp_path.glob("*.zip")) == []
    set_free(100 * GB)
    assert CliRunner().invoke(app, words).exit_code == 0


def test_a_worker_begins_nothing_on_a_disk_that_is_nearly_full(bench: Bench, set_free: SetFree) -> None:
    arguments = {"mesh": "0" * 64, "radius_m": 0.015, "expected": 10}
    enqueue(bench.store, bench.run_id, NewJob("locate_spheres", "fixation", 1, "key", arguments), actor="test")
    set_free(LEAST_FREE_BYTES - 1)
    looks: list[str] = []

    def stop() -> bool:
        looks.append(bench.store.jobs(bench.run_id)[0].state)
        if len(looks) == 4:
            set_free(100 * GB)
        return len(looks) > 5

    assert work(bench.store, until_idle=True, stop=stop, progress=lambda _what, _done, _total: None) == 1
    assert looks[:4] == ["queued"] * 4
    assert bench.store.jobs(bench.run_id)[0].state == "failed"  # there is no such mesh
