"""A second place of the signatures that is away: told, tried again, and no reason to stop for anything."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.core.records.events import SignInRecorded
from service.core.records.run_events import DeviceTrouble
from service.store.durable_effects import DurableFiles
from service.store.records import SITE
from service.store.signatures.log import NAME
from service.store.signatures.second_place import Away, LogCopy, SecondPlace, away_words
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.web import web_site
from tests.support.processes.waiting import until
from tests.support.record.ailing_place import WAYS, Ailing
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import capture, start_run
from tests.support.runs.bench_run import PROTOCOL, begin_run, bench_store


@pytest.fixture
def data(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    with Store.open(folder, SteppedClock()) as store:
        run = start_run(store)
        capture(store, run, "v1")
        checkpoint(store, run)
    return folder


def sign(data: Path) -> None:
    with Store.open(data) as store:
        store.record_site([SignInRecorded(account="ada", outcome="signed_out")], actor="ada")
        checkpoint(store, SITE)


def the_same(data: Path, copy: Path) -> Callable[[], bool]:
    return lambda: copy.is_file() and copy.read_bytes() == (data / NAME).read_bytes()


@pytest.mark.parametrize("way", WAYS)
def test_a_place_that_is_away_is_told_and_gets_what_is_missing_when_it_is_back(
    data: Path, tmp_path: Path, way: str
) -> None:
    ailing = Ailing(way, tmp_path)
    place = ailing.place(data)
    away = place.update()
    assert away is not None
    assert WAYS[way] in away.why
    assert str(ailing.copy) in away_words(away)
    sign(data)
    again = place.update()
    assert again is not None
    assert again.since_utc == away.since_utc
    ailing.mend()
    until(lambda: place.update() is None, "it is never up to date")
    assert the_same(data, ailing.copy)()
    assert verify(data, signatures_copy=ailing.copy).ok


def test_a_place_goes_away_in_between_and_comes_back(data: Path, tmp_path: Path) -> None:
    copy = tmp_path / "share" / NAME
    copy.parent.mkdir()
    place = SecondPlace.of(data, copy, SteppedClock(), DurableFiles())
    assert place.update() is None
    copy.parent.rename(tmp_path / "unmounted")
    sign(data)
    assert place.update() is not None
    (tmp_path / "unmounted").rename(copy.parent)
    assert place.update() is None
    assert the_same(data, copy)()


def test_nobody_waits_twice_for_a_place_that_hangs(data: Path, tmp_path: Path) -> None:
    ailing = Ailing("hangs", tmp_path)
    place = ailing.place(data)
    place.update()
    before = threading.active_count()
    for _ in range(20):
        assert place.update() is not None
    assert threading.active_count() == before, "one thread waits there"
    ailing.mend()
    until(lambda: place.away is None, "it is never up to date")
    assert the_same(data, ailing.copy)(), "the thread that waited writes what was missing"


def test_it_is_tried_again_where_nobody_signs(data: Path, tmp_path: Path) -> None:
    ailing = Ailing("no folder", tmp_path)
    clock = SteppedClock()
    place = SecondPlace.of(data, ailing.copy, clock, DurableFiles())
    place.update()
    ended = clock.signal()
    looking = threading.Thread(target=place.look_after, args=(ended,))
    looking.start()
    ailing.mend()

    def later() -> bool:
        clock.passed_s += 60
        return place.away is None

    until(later, "it is never tried again")
    ended.set()
    looking.join()
    assert the_same(data, ailing.copy)()


def test_a_copy_of_another_folder_is_told_and_left(data: Path, tmp_path: Path) -> None:
    copy = tmp_path / NAME
    copy.write_bytes(b'{"number":1}\n')
    away = SecondPlace.of(data, copy, SteppedClock(), DurableFiles()).update()
    assert away is not None
    assert "is not the beginning of the log" in away.why
    assert copy.read_bytes() == b'{"number":1}\n'


def test_what_was_compared_once_is_not_read_again(data: Path, tmp_path: Path) -> None:
    """But its last line is: a copy that was cut or altered there is found."""
    copy = LogCopy(data / NAME, tmp_path / NAME)
    copy.bring_up_to_date()
    whole = copy.copy.stat().st_size
    sign(data)
    copy.bring_up_to_date()
    assert the_same(data, copy.copy)()
    copy.copy.write_bytes(copy.copy.read_bytes()[: whole // 2])
    copy.bring_up_to_date()
    assert the_same(data, copy.copy)()


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("moment", ["from the beginning", "in mid-run"])
def test_a_run_goes_on_and_its_record_says_once_that_the_place_was_away(
    tmp_path: Path, way: str, moment: str
) -> None:
    with bench_store(tmp_path / "data") as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        ailing = Ailing(way if moment == "from the beginning" else "no folder", tmp_path)
        if moment == "in mid-run":
            ailing.mend()
            checkpoint(store, bench.run_id)

            def goes_away(_seconds: float) -> None:
                bench.on_wait = None
                ailing.go_away(way)

            bench.on_wait = goes_away
        bench.second_place = place = ailing.place(tmp_path / "data")
        assert bench.run().status == "completed"
        troubles = [e.payload for e in store.events(bench.run_id) if isinstance(e.payload, DeviceTrouble)]
        (trouble,) = [one for one in troubles if one.device == "second place of signatures"]
        assert str(ailing.copy) in trouble.message
        assert any("has not been up to date since" in words for words in bench.operator.told)
        report = verify(tmp_path / "data")
        assert report.ok, report.first_fault
        assert not any(report.unsigned_events.values())
        ailing.mend()
        until(lambda: place.update() is None, "it is never up to date")
    assert the_same(tmp_path / "data", ailing.copy)()


def test_every_page_says_that_the_place_is_away_and_health_does_too(tmp_path: Path) -> None:
    with web_site(tmp_path) as web:
        ailing = Ailing("no folder", tmp_path)
        web.site.second_place = ailing.place(web.site.data)
        stranger, technician = web.browser(), web.browser("technician")
        stranger.sign_in("ada")  # signs the site's chain, and looks for the place
        for address in ("/", "/history", "/account"):
            page = technician.get(address).text
            assert "The second place of the signatures is not up to date" in page
            assert "share [of the lab]" in page
        assert "second place" not in web.browser().get("/sign-in").text
        health = stranger.get("/health")
        assert health.status_code == 503
        assert health.json()["second_place"]["ok"] is False
        assert "share" not in health.text, "it names no path"
        assert 'orthocapture_healthy{part="second_place"} 0.0' in technician.get("/metrics").text
        ailing.mend()
        web.browser().sign_in("ada")
        assert "second place" not in technician.get("/").text
        assert stranger.get("/health").json()["second_place"] == {"ok": True, "what": ""}
    assert the_same(tmp_path / "data", ailing.copy)()


GONE = "gone [bold]/x/[/mnt]/signatures.jsonl"
CHECKLIST = """\
id: by_hand
version: "1"
title: By hand
spheres: {radius_mm: 15, registration: 10, control: 3}
board: {columns: 4, rows: 5, square_mm: 15}
camera: {aperture_f: 22, exposure_s: 1/50, iso: 100}
motion: {dwell_s: 0.0}
settle: {window_s: 0.01, timeout_s: 5}
steps:
  - {id: fixation, kind: checklist, title: Fix the specimen, checklist: [wires hold]}
"""


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    path = tmp_path / "rig.yaml"
    path.write_text(
        'name: r\nsimulated: true\ndevices: {}\nsignature_copy: "gone [bold]/x/[/mnt]/signatures.jsonl"\n'
    )
    return path


def test_run_in_a_terminal_does_not_mind_and_says_so(tmp_path: Path, rig: Path) -> None:
    """Whose name looks like markup."""
    protocol = tmp_path / "by_hand.yaml"
    protocol.write_text(CHECKLIST)
    words = ["run", str(protocol), "--rig", str(rig), "--data", str(tmp_path / "data"), "--auto-confirm", "--json"]
    done = CliRunner().invoke(app, [*words, "--no-worker"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["status"] == "completed"
    assert GONE in done.stderr.replace("\n", "")


def test_doctor_tells_it(tmp_path: Path, rig: Path) -> None:
    words = ["doctor", "--rig", str(rig), "--data", str(tmp_path / "data")]
    told = CliRunner().invoke(app, words)
    assert told.exit_code == 1
    assert GONE in told.output
    assert "No such file or directory" in told.output
    as_json = json.loads(CliRunner().invoke(app, [*words, "--json"]).stdout)
    assert as_json["ok"] is False
    assert as_json["second_place"]["problem"] != ""
    (tmp_path / "gone [bold]" / "x" / "[" / "mnt]").mkdir(parents=True)
    well = json.loads(CliRunner().invoke(app, [*words, "--json"]).stdout)
    assert well["second_place"]["problem"] == ""
    assert well["ok"] is True


def test_words_of_a_place_that_is_away() -> None:
    words = away_words(Away(Path("/mnt/share/s.jsonl"), "2026-11-27T12:00:00.000000Z", "it hangs"))
    assert words.startswith("the second place of the signatures, /mnt/share/s.jsonl, has not been up to date since ")
    assert ": it hangs. It is tried again by itself" in words
