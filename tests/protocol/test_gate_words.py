"""A gate judged with its uncertainty: every reader sees its bounds, and `not decided` where that is the case."""

from __future__ import annotations

import json
from collections.abc import Generator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.audit import overview
from service.audit.background import PartialProgress
from service.audit.overview import digests
from service.audit.recorded_run import read_run
from service.audit.report import report_content
from service.audit.report_output import render_html
from service.cli.common import console
from service.cli.main import app
from service.core.gates import describe, describe_judged, figure, quantity, standing
from service.core.records.run_events import GateVerdict, Uncertainty
from service.dataset.exporter import exporter, write_data_set
from service.dataset.run_data_set import data_set_of
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.web import WebSite, web_site
from tests.support.processes.waiting import until
from tests.support.recorded.calibrated_run import begin_calibrated_run
from tests.support.recorded.reported_run import record_reported_run

BOUNDED = "0.340 mm, 0.300 to 0.380"


def verdict(value: float | None, lower: float | None = None, upper: float | None = None) -> GateVerdict:
    undecided = lower is not None and upper is not None and lower <= 0.35 < upper
    return GateVerdict(
        measure="error_mm", value=value, minimum=None, maximum=0.35, unit="mm", undecided=undecided,
        passed=value is not None and (upper or value) <= 0.35, lower=lower, upper=upper,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("judged", "shown", "line"),
    [
        (verdict(0.2), "0.2 mm", "Error 0.2 mm, allowed ≤ 0.35"),
        (verdict(0.34, 0.3, 0.38), BOUNDED, f"Error {BOUNDED}, allowed ≤ 0.35: not decided"),
        (verdict(0.2, 0.1999, 0.2001), "0.2000 mm, 0.1999 to 0.2001", ""),
        (verdict(0.2, 0.2, 0.2), "0.20 mm, 0.20 to 0.20", ""),
        (verdict(0.34, upper=0.38), "0.34 mm", ""),  # a bound alone is not shown as if there were two
        (verdict(0.34, lower=0.3), "0.34 mm", ""),
        (verdict(None), "not measured", "Error was not measured, allowed ≤ 0.35"),
    ],
)
def test_a_figure_is_written_one_way(judged: GateVerdict, shown: str, line: str) -> None:
    assert figure(judged) == shown
    assert describe_judged(judged) == (line or describe(judged))


def test_how_a_gate_stands() -> None:
    assert standing(verdict(0.2)) == "within"
    assert standing(verdict(0.4)) == standing(verdict(None)) == "outside"
    assert standing(verdict(0.34, 0.3, 0.38)) == "not_decided"
    assert standing(verdict(0.34, 0.3, 0.38), accepted=True) == standing(verdict(0.4), accepted=True) == "accepted"
    assert standing(verdict(0.2), accepted=True) == "within"
    assert (quantity(8.0, "images"), quantity(1e9), quantity(0.71312, "px")) == ("8 images", "1e+09", "0.7131 px")


@pytest.fixture
def undecided(tmp_path: Path) -> tuple[Path, str]:
    """A run that waits at an evaluation whose bounds lie on both sides of its limit."""
    return tmp_path / "data", record_reported_run(tmp_path, error_mm=0.34, error_bounds_mm=(0.3, 0.38))


def test_the_first_page_counts_what_is_not_decided_apart(undecided: tuple[Path, str]) -> None:
    data, run_id = undecided
    with Store.open(data) as store:
        computed = digests(store)
        digest = computed.get(run_id, wait_s=60.0)
        computed.close()
    assert not isinstance(digest, PartialProgress)
    counted = overview.counts(digest)
    assert (counted["failed_gates"], counted["undecided_gates"]) == (1, 1)  # too few views before the redo
    (one,) = overview.findings(digest, "undecided_gates")
    assert one.name == "Gate not decided"
    assert f"{BOUNDED}, allowed ≤ 0.35: not decided" in one.text
    (failed,) = overview.findings(digest, "failed_gates")
    assert failed.name == "Gate failed"
    assert {f.kind for f in overview.failed_gates(digest)} == {"failed_gate", "undecided_gate"}
    assert {f.kind for f in overview.findings(digest)} == {d.kind for d in digest.deviations}


def test_the_report_shows_bounds_and_says_what_they_are(undecided: tuple[Path, str]) -> None:
    data, run_id = undecided
    page = render_html(report_content(read_run(data, run_id), verify(data)))
    assert f"Mean radial error of the registration used {BOUNDED}, allowed ≤ 0.35: not decided" in page
    assert "gate not decided" in page
    assert "? not decided" in page
    assert page.count("0.030 px, 0.023 to 0.037") == 2  # steps and gates, certificate
    assert "each one-sided with 99 % confidence" in page


def test_an_accepted_figure_is_said_to_be_accepted_not_failed(tmp_path: Path) -> None:
    run_id = record_reported_run(tmp_path, error_mm=0.34, error_bounds_mm=(0.3, 0.38), accepted_by="Emmy")
    data = tmp_path / "data"
    run = read_run(data, run_id)
    page = render_html(report_content(run, verify(data)))
    assert "! accepted" in page
    assert "? not decided" not in page
    assert f"{BOUNDED}, allowed ≤ 0.35: not decided; accepted by Emmy" in page


def test_the_command_shows_every_figure(undecided: tuple[Path, str], monkeypatch: pytest.MonkeyPatch) -> None:
    data, run_id = undecided
    monkeypatch.setattr(console, "width", 220)  # a narrower table breaks its lines
    done = CliRunner().invoke(app, ["status", run_id, "--data", str(data)])
    assert f"Mean radial error of the registration used {BOUNDED}, allowed ≤ 0.35: NOT DECIDED" in done.output
    assert "RMS reprojection error 0.030 px, 0.023 to 0.037, allowed ≤ 0.5: ok" in done.output
    told = json.loads(CliRunner().invoke(app, ["status", run_id, "--data", str(data), "--json"]).output)
    (gate,) = told["steps"]["evaluation"]["gates"]
    assert (gate["standing"], gate["lower"], gate["upper"]) == ("not_decided", 0.3, 0.38)


def test_the_data_set_tells_how_its_gates_stand(tmp_path: Path) -> None:
    bounds = (0.3, 0.38)
    run_id = record_reported_run(tmp_path, error_mm=0.34, error_bounds_mm=bounds, accepted_by="Emmy", registered=True)
    dataset = data_set_of(read_run(tmp_path / "data", run_id).summary())
    write_data_set(dataset, exporter("plain"), tmp_path / "out")
    told = json.loads((tmp_path / "out" / "dataset.json").read_text())
    assert told["gates"]["evaluation"] == [
        f"Mean radial error of the registration used {BOUNDED}, allowed ≤ 0.35: accepted"
    ]
    assert told["gates"]["calibration"] == ["RMS reprojection error 0.030 px, 0.023 to 0.037, allowed ≤ 0.5: within"]


@pytest.fixture
def web(undecided: tuple[Path, str]) -> Generator[WebSite]:
    with web_site(undecided[0].parent) as site:
        yield site


def test_the_pages_show_bounds_and_what_is_not_decided(web: WebSite, undecided: tuple[Path, str]) -> None:
    browser, run_id = web.browser("auditor"), undecided[1]
    page = browser.get(f"/runs/{run_id}").text
    assert BOUNDED in page
    assert "Not decided" in page
    listed = {"group": "undecided_gates"}  # computed in the background
    until(
        lambda: "Gate not decided" in browser.get(f"/audit/runs/{run_id}/deviations", params=listed).text,
        "nothing is listed",
    )
    timeline = browser.get(f"/audit/runs/{run_id}/timeline", params={"kind": "gates_evaluated"}).text
    assert '<span class="event-text">not decided</span>' in timeline


def test_the_calibration_and_its_certificate_show_bounds(tmp_path: Path) -> None:
    with web_site(tmp_path) as web:
        known = Uncertainty(sigma=0.003, lower=0.023, upper=0.037)
        run_id = begin_calibrated_run(web, {"hand_eye_held_out_mm": known})
        browser = web.browser("auditor")
        for address in ("calibration", "calibration/certificate"):
            assert " mm, 0.023 to 0.037" in browser.get(f"/runs/{run_id}/{address}").text, address
