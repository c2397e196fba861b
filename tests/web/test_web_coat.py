"""The clock of the coat, on every page of a run: from the spray until its scan has passed, and never guessed."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.core.records.run_events import OperatorAction
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.web import run
from tests.support.pages.browsed_run import words
from tests.support.pages.web import WebSite, web_site
from tests.support.runs.bench_run import PROTOCOL, Bench

_COATED = (
    PROTOCOL.split("steps:\n", maxsplit=1)[0]
    + """\
steps:
  - id: spraying
    kind: timed_application
    title: Spray
    params: {product: Aesub Blue, sublimates_after_s: 14400, scan_within_s: 2700}
  - id: scan
    kind: scan_import
    title: Import the scan
    params: {spheres: 5, application: spraying}
    gates: [{measure: since_application_min, max: 40, unit: min}]
"""
)
_PAGES = ("", "/capture", "/scene", "/calibration", "/dataset")


class _LeftError(Exception):
    """The person has gone."""


def _leave(_question: AskOperator, _state: RunState) -> OperatorAction:
    raise _LeftError


@pytest.fixture
def web(tmp_path: Path) -> Iterator[WebSite]:
    with web_site(tmp_path) as site:
        yield site


@pytest.fixture
def sprayed(web: WebSite) -> Bench:
    """A run whose coat was applied just now, and which waits at its scan."""
    bench = web.begin_run(_COATED)
    bench.script("scan", "confirm", _leave)
    with contextlib.suppress(_LeftError):
        bench.run()
    return bench


def _coat(page: str) -> str:
    """What a page says of the coat; "" if nothing."""
    found = re.search(r'<p class="coat coat-\w+">.*?</p>', page, re.DOTALL)
    return words(found[0]).strip() if found else ""


def test_every_page_of_the_run_counts_down_to_the_limit_of_the_gate(web: WebSite, sprayed: Bench) -> None:
    browser = web.browser("technician")
    sprayed.clock.passed_s += 12 * 60
    for page in _PAGES:
        said = _coat(browser.get(f"/runs/{sprayed.run_id}{page}").text)
        assert said.startswith("Coat of Aesub Blue: 27 min left."), page
        assert "the export for “Import the scan” has to arrive within 40 min" in said
        assert re.search(r"That is at \d\d:\d\d:\d\d UTC", said)
    assert "27 min left" in _coat(browser.get(f"/runs/{sprayed.run_id}/parts/banner").text)
    answer = CliRunner().invoke(app, ["status", sprayed.run_id, "--data", str(web.site.data), "--json"])
    assert json.loads(answer.stdout)["coats"][0].startswith("Coat of Aesub Blue: ")


def test_the_page_is_drawn_anew_as_the_time_goes(web: WebSite, sprayed: Bench) -> None:
    """The news of a run differ when the words of the clock do: each minute, and each ten seconds near the end."""
    newest = run.newest
    sprayed.clock.passed_s += 600.0
    first = newest(web.site, sprayed.run_id)
    sprayed.clock.passed_s += 61.0
    assert newest(web.site, sprayed.run_id) != first
    sprayed.clock.passed_s = 36 * 60.0
    close = newest(web.site, sprayed.run_id)
    sprayed.clock.passed_s += 11.0
    assert newest(web.site, sprayed.run_id) != close


@pytest.mark.parametrize(
    ("passed_s", "by_s", "boots", "said"),
    [
        (37 * 60.0, 0.0, False, "2 min 50 s left"),
        (39.7 * 60, 0.0, False, "10 s left"),
        (41 * 60.0, 0.0, False, "2 min too old. It was applied 41 min ago; the protocol's limit"),
        (250 * 60.0, 0.0, False, "211 min too old. It has disappeared after 4 h"),
        (600.0, 600.0, True, "19 min left"),
        (600.0, -3600.0, False, "how old it is cannot be known. The computer's clock was set back by 3600 s"),
        (600.0, -3600.0, True, "how old it is cannot be known. After a restart the computer's clock is"),
    ],
)
def test_it_survives_a_reboot_and_a_corrected_clock_or_says_that_it_cannot_be_known(
    web: WebSite, sprayed: Bench, passed_s: float, by_s: float, boots: bool, said: str
) -> None:
    browser = web.browser("technician")
    sprayed.clock.passed_s += passed_s
    if boots:
        sprayed.clock.reboot(by_s)
    elif by_s:
        sprayed.clock.set_utc(by_s)
    shown = _coat(browser.get(f"/runs/{sprayed.run_id}/parts/banner").text)
    assert said in shown
    if "cannot be known" in shown:
        assert "The limit of 40 min will not count as met" in shown


def test_there_is_no_clock_before_the_spray_and_none_after_the_end(web: WebSite, sprayed: Bench) -> None:
    browser = web.browser("technician")
    before = web.begin_run(_COATED)
    assert _coat(browser.get(f"/runs/{before.run_id}").text) == ""
    assert _coat(browser.get(f"/runs/{sprayed.run_id}").text) != ""
    sprayed.act("abort", reason="enough")
    assert _coat(browser.get(f"/runs/{sprayed.run_id}").text) == ""
