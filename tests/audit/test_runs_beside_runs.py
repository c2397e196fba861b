"""Two runs side by side, and calibration and accuracy over time: from the record, on pages and by commands."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Generator
from dataclasses import dataclass
from html import unescape
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from service.audit.runs import by_instrument, history
from service.cli.main import app
from service.core.records.run_events import DeviceOpened
from service.store.store import Store
from service.store.verification.verify import verify
from service.web.charts import TimePoint, time_chart
from tests.support.pages.browsed_run import words
from tests.support.pages.web import WebSite, web_site
from tests.support.recorded.reported_run import record_reported_run


@dataclass(frozen=True)
class Two:
    """A site with two runs, of two contents of one protocol, one of which is more accurate."""

    web: WebSite
    good: str
    bad: str


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Generator[Two]:
    folder = tmp_path_factory.mktemp("two")
    good = record_reported_run(folder, person="grace")
    bad = record_reported_run(folder, error_mm=0.9, person="grace", acceptable=True)
    with web_site(folder) as web:
        yield Two(web, good, bad)


def typed(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments))


def test_two_runs_stand_side_by_side_on_a_page(two: Two) -> None:
    browser = two.web.browser("auditor")
    page = words(browser.get("/compare", params={"run": [two.good, two.bad]}).text)
    assert "Different content 2 lines differ" in page
    assert re.search(r"\+ \d+: gates: \[\{measure: best_mean_radial_error_mm, max: 0.35, unit: mm, accept_by", page)
    assert "mean radial error 0.213 mm 0.900 mm +0.687 mm" in page
    assert (
        "Mean radial error of the registration used 0.213 mm (≤ 0.35): within 0.9 mm (≤ 0.35): outside +0.687 mm"
        in page
    )
    assert "rms px 0.03 px 0.03 px" in page
    assert "Camera fx 2033.77 px 2033.77 px" in page
    assert "Whole run" in page
    assert page.count("the cable was loose") == 2
    assert "State completed active differs" in page


def test_the_choice_of_runs_says_what_is_missing(two: Two) -> None:
    browser = two.web.browser("auditor")
    assert "Choose two runs." in words(browser.get("/compare").text)
    assert "Choose a second run" in words(browser.get("/compare", params={"run": two.good}).text)
    assert "Choose a second run" in words(browser.get("/compare", params={"run": [two.good, two.good]}).text)
    three = browser.get("/compare", params={"run": [two.good, two.bad, "x"]})
    assert "3 runs were ticked: two can be compared." in words(three.text)
    assert browser.get("/compare", params={"run": [two.good, "20990101-000000-ffffff"]}).status_code == 404
    home = browser.get("/").text
    assert f'<input type="checkbox" name="run" value="{two.good}">' in home
    assert 'action="/compare"' in home
    assert '<a href="/history"' in home


def test_two_runs_side_by_side_in_the_terminal(two: Two) -> None:
    data = ("--data", str(two.web.site.data))
    shown = typed("compare", two.good, two.bad, *data)
    assert shown.exit_code == 0, shown.output
    assert "2 lines of the protocol differ" in shown.stdout
    assert "+0.687 mm" in shown.stdout
    assert "Camera fx" not in shown.stdout  # the same in both
    assert "Camera fx" in typed("compare", two.good, two.bad, "--all", *data).stdout
    record = json.loads(typed("compare", two.good, two.bad, "--json", *data).stdout)
    assert record["same_protocol"] is False
    (row,) = (row for row in record["accuracy"] if row["name"] == "mean radial error")
    assert (row["first"], row["second"], row["change"]) == ("0.213 mm", "0.900 mm", "+0.687 mm")
    same = json.loads(typed("compare", two.good, two.good, "--json", *data).stdout)
    assert same["same_protocol"] is True
    assert [
        row for part in ("gates", "measures", "accuracy", "calibration") for row in same[part] if row["differs"]
    ] == []
    assert typed("compare", two.good, "nothing", *data).exit_code == 1


def test_a_run_of_another_protocol_can_be_compared_too(two: Two) -> None:
    other = two.web.begin_run().run_id
    page = words(two.web.browser("auditor").get("/compare", params={"run": [two.good, other]}).text)
    assert "Protocol reported 3 bench 1" in page
    assert "0.213 mm –" in page


def test_figures_over_time_by_camera_lens_and_arm(tmp_path: Path) -> None:
    runs = [record_reported_run(tmp_path, error_mm=error_mm, person="grace") for error_mm in (0.213, 0.2, 0.9)]
    with Store.open(tmp_path / "data") as store:
        for run_id, serial in zip(runs, ("1234567", "1234567", "7654321"), strict=True):
            identity = {"kind": "camera", "model": "ILCE-7RM5", "serial": serial, "driver": "gphoto"}
            store.record(run_id, [DeviceOpened(device="camera", report={"identity": identity})], actor="runner")
        found = by_instrument(history(store))
    names = {
        f"{one.kind} {one.model} {one.serial}": [row.run.basics.run_id for row in rows] for one, rows in found.items()
    }
    assert names == {
        "camera ILCE-7RM5 1234567": runs[:2],
        "camera ILCE-7RM5 7654321": runs[2:],
        "lens FE 50mm ": runs,
        "arm UR10e 20231": runs,
    }
    with web_site(tmp_path) as web:
        browser = web.browser("auditor")
        page = browser.get("/history").text
        for told in (
            "ILCE-7RM5, serial number 1234567",
            "FE 50mm, serial number not stated",
            "UR10e, serial number 20231",
        ):
            assert told in words(page)
        assert page.count('<svg viewBox="0 0 640') == 3 + 3 + 3 + 1  # by instrument
        assert f"0.9 mm, {web.store.first_event(runs[2]).at_utc[:10]}" in unescape(page)
        assert "No run of a real rig has" in words(browser.get("/history?rigs=real").text)
        assert browser.get("/history?rigs=other").status_code == 422
        answer = browser.get("/history.csv")
        assert answer.headers["content-type"].startswith("text/csv")
        rows = list(csv.DictReader(io.StringIO(answer.text)))
    assert [row["run"] for row in rows] == runs
    assert [row["mean_radial_error_mm"] for row in rows] == ["0.213", "0.2", "0.9"]
    assert [row["accuracy"] for row in rows] == ["within", "within", "outside"]
    assert {row["mean_radial_error_limit_mm"] for row in rows} == {"0.35"}
    assert {(row["fx_px"], row["rms_px"], row["arm_serials"]) for row in rows} == {("2033.77", "0.03", "20231")}
    done = typed("history", "--out", str(tmp_path / "history.csv"), "--data", str(tmp_path / "data"))
    assert done.exit_code == 0, done.output
    assert (tmp_path / "history.csv").read_text(encoding="utf-8").splitlines() == answer.text.splitlines()
    assert verify(tmp_path / "data", runs[0]).ok


def test_a_spreadsheet_takes_no_word_for_a_formula(tmp_path: Path) -> None:
    with web_site(tmp_path) as web:
        assert web.browser("technician").send_form(
            "/runs", protocol="bench.yaml", specimen="=1+1"
        ).status_code == 303  # fmt: skip
        assert typed("history", "--data", str(web.site.data)).stdout.count("\n") == 1  # no figures: only the header
    record_reported_run(tmp_path, person="=grace")
    shown = typed("history", "--data", str(tmp_path / "data"))
    assert shown.stdout.count("\n") == 2
    assert ",=" not in shown.stdout


def test_a_chart_places_points_by_time_and_value() -> None:
    points = [
        TimePoint("2026-11-01T10:00:00Z", 0.1, "a"),
        TimePoint("2026-11-03T10:00:00Z", 0.2, "b", simulated=True),
        TimePoint("2026-11-05T10:00:00Z", 0.3, "c"),
    ]
    chart = time_chart(points, title="Error", unit="mm", limit=0.25)
    assert chart is not None
    first, middle, last = chart.marks
    assert abs(middle.x - (first.x + last.x) / 2) < 0.2
    assert chart.limit is not None
    assert first.y > middle.y > chart.limit > last.y
    assert len(chart.lines) == 1  # of real rigs; a single simulated value has none
    assert [tick.text for tick in chart.x_ticks] == ["2026-11-03", "2026-11-05"]
    focal = time_chart(points[:1], title="Focal length", unit="px", from_zero=False)
    assert focal is not None
    assert focal.marks[0].x == pytest.approx((focal.left + focal.right) / 2, abs=0.2)
    assert time_chart([], title="", unit="") is None
