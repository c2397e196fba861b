"""Every page, report, bundle and data set gives the same deviations of a run, and the same number of them."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.audit.bundle import bundle_report, export_bundle
from service.audit.recorded_run import read_run
from service.audit.report import report_content
from service.audit.report_output import render_html
from service.cli.main import app
from service.core.run.fold import fold
from service.core.run.state import Deviation
from service.core.words import counted
from service.dataset.exporter import exporter, write_data_set
from service.dataset.run_data_set import data_set_of
from service.run_start import recorded_run
from service.store.verification.verify import verify
from tests.support.pages.browsed_run import words
from tests.support.pages.web import WebSite, web_site
from tests.support.processes.waiting import until
from tests.support.recorded.reported_run import record_reported_run
from tests.support.runs.recorded_run import record_run

# How a run ended → what is given to the recorder: each has failed gates, faults or corrections beside its deviations.
RUNS = ("completed", "accepted", "outside", "repeated", "without")


@pytest.fixture(scope="module")
def web(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WebSite]:
    with web_site(tmp_path_factory.mktemp("deviations")) as made:
        yield made


@pytest.fixture(scope="module")
def runs(web: WebSite) -> dict[str, str]:
    return {
        "completed": record_reported_run(web.folder, registered=True, person="grace"),
        "accepted": record_reported_run(
            web.folder, registered=True, person="grace", error_mm=0.9, accepted_by="emmy"
        ),
        "outside": record_reported_run(web.folder, registered=True, person="grace", error_mm=0.9),
        "repeated": record_run(web.folder),
        "without": web.begin_run().run_id,
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    "which",
    [pytest.param(which, marks=pytest.mark.sweep(always=which in ("completed", "accepted"))) for which in RUNS],
)
def test_one_list_of_deviations_stands_everywhere(
    web: WebSite, runs: dict[str, str], which: str, tmp_path: Path
) -> None:
    run_id = runs[which]
    found = fold(recorded_run(web.store, run_id)[0], web.store.events(run_id)).deviations
    assert bool(found) == (which != "without")
    _on_pages(web, run_id, found, other=next(other for other in runs.values() if other != run_id))
    _in_the_terminal(web, run_id, found)
    _in_the_report(web, run_id, found)
    if which in ("completed", "accepted"):
        _in_what_leaves(web, run_id, found, tmp_path)


def _on_pages(web: WebSite, run_id: str, found: tuple[Deviation, ...], *, other: str) -> None:
    browser = web.browser("supervisor")

    def read(address: str) -> str:
        page = ""

        def computed() -> bool:
            nonlocal page
            page = browser.get(address).text
            return "data-pending" not in page.split("<main", 1)[-1] and "Being read" not in page

        until(computed, f"{address} is computed")
        return page

    number = len(found)
    run_page = read(f"/runs/{run_id}")
    assert f'<h2>Deviations <span class="muted num">{number}</span></h2>' in run_page
    for one in found[-8:]:
        assert one.text in words(run_page)
    if "The run is complete" in run_page:
        assert f"{counted(number, 'deviation')} from the protocol" in words(run_page)
    overview = read(f"/audit/runs/{run_id}")
    section = overview[overview.index('id="deviations-title"') : overview.index('id="notes-title"')]
    assert f'Deviations <span class="muted num">{number}</span>' in section
    assert section.count("<tr><td") == number
    assert sum(map(int, re.findall(r'count-number num">(\d+)<', section))) == number
    listed = read(f"/audit/runs/{run_id}/deviations")
    assert listed.count("<tr><td") == number
    assert f'All deviations <span class="num">{number}</span>' in listed
    rows = read("/audit").split("<tr")
    (row,) = [row for row in rows if run_id in row]
    assert f">{number}<" in row, row
    if web.site.run(run_id).state.terminal:
        shown = [row for row in read("/").split("<tr") if f"/runs/{run_id}" in row]
        assert any(f'<td class="num">{number}</td>' in row for row in shown)
        assert browser.send_form(f"/audit/runs/{run_id}/verification", back="exports").status_code == 303
        release = words(read(f"/runs/{run_id}/exports"))
        assert counted(number, "deviation") in release or "You cannot release it" in release
    compared = read(f"/compare?run={run_id}&run={other}")
    part = compared[compared.index('id="deviations"') :]
    assert f"{run_id} {number} " in words(part)


def _in_the_terminal(web: WebSite, run_id: str, found: tuple[Deviation, ...]) -> None:
    told = CliRunner().invoke(app, ["status", run_id, "--data", str(web.site.data), "--json"])
    assert json.loads(told.stdout)["deviations"] == [one.text for one in found]
    plain = CliRunner().invoke(app, ["status", run_id, "--data", str(web.site.data)]).stdout
    assert plain.count("deviation: ") == len(found)


def _in_the_report(web: WebSite, run_id: str, found: tuple[Deviation, ...]) -> None:
    run = read_run(web.site.data, run_id)
    report = report_content(run, verify(web.site.data, run_id), with_scene=False, with_pictures=False)
    assert report.sections[0].title == "Deviations"
    _numbered(render_html(report), found)


def _numbered(html: str, found: tuple[Deviation, ...]) -> None:
    """The number on the first page of a report, and the rows of its first table, are those of `found`."""
    said = words(html)
    if not found:
        assert "No deviation in what was done" in said
        return
    assert f"{counted(len(found), 'deviation')}, listed first" in said
    table = html[html.index("<table", html.index("Deviations</h2>")) :].split("</table>", 1)[0]
    assert table.count("<tr") - 1 == len(found)
    for one in found:
        assert one.text in words(table)


def _in_what_leaves(web: WebSite, run_id: str, found: tuple[Deviation, ...], folder: Path) -> None:
    texts = [one.text for one in found]
    run = read_run(web.site.data, run_id)
    write_data_set(data_set_of(run.summary()), exporter("plain"), folder / "dataset")
    assert json.loads((folder / "dataset" / "dataset.json").read_text())["deviations"] == texts
    card = (folder / "dataset" / "DATACARD.md").read_text()
    assert card.split("Deviations from the protocol:\n\n")[1].split("\n\n")[0].splitlines() == [
        f"- {text}" for text in texts
    ]
    crate = (folder / "dataset" / "ro-crate-metadata.json").read_text()
    assert crate.count("Deviation: ") == len(found)
    report = bundle_report(web.site.data, run_id, with_pictures=False)
    target = folder / "bundle.zip"
    bundle = export_bundle(web.store, run_id, target, actor="emmy", hashes_only=True, report=report).path
    with zipfile.ZipFile(bundle) as opened:
        name = next(name for name in opened.namelist() if name.endswith("report.html"))
        _numbered(opened.read(name).decode(), found)
