"""Reasons to choose from, the protocol's own or the defaults, beside free words; the text of both is recorded."""

from __future__ import annotations

import re
from collections.abc import Generator
from html import unescape
from pathlib import Path

import pytest

from service.core.errors import ProtocolError
from service.core.protocol import Reasons
from service.core.records.run_events import OperatorAction
from tests.support.pages.web import Browser, WebSite, web_site
from tests.support.record.core import TOY, load
from tests.support.runs.bench_run import PROTOCOL, Bench

OWN = PROTOCOL + 'reasons: {skip: [Done the day before, "No K-wires at hand"]}\n'


@pytest.fixture
def web(tmp_path: Path) -> Generator[WebSite]:
    with web_site(tmp_path) as site:
        yield site


def begin(web: WebSite, protocol: str) -> tuple[Bench, Browser]:
    bench = web.begin_run(protocol)
    browser = web.browser("technician")
    web.take_control(bench.run_id, browser)
    return bench, browser


def offered(page: str, dialog: str) -> list[str]:
    part = page[page.index(f'id="{dialog}"') :].partition("</dialog>")[0]
    return [unescape(text) for text in re.findall(r'name="preset" value="([^"]+)"', part)]


def skip(bench: Bench, browser: Browser, **fields: str) -> int:
    state = bench.state()
    shown = {"verb": "skip", "step": state.current, "attempt": 1, "seen_seq": state.seq}
    return browser.send_form(f"/runs/{bench.run_id}/actions", **shown, **fields).status_code


def test_a_protocol_offers_its_own_reasons_and_good_ones_for_the_rest(web: WebSite) -> None:
    bench, browser = begin(web, OWN)
    page = browser.get(f"/runs/{bench.run_id}").text
    assert offered(page, "dialog-skip") == ["Done the day before", "No K-wires at hand"]
    bench.store.record(bench.run_id, [OperatorAction(action="skip", step="fixation", reason="done")], actor="grace")
    assert offered(browser.get(f"/runs/{bench.run_id}").text, "dialog-redo") == list(Reasons().redo)


@pytest.mark.parametrize(
    ("fields", "recorded"),
    [
        ({"preset": "Done the day before"}, "Done the day before"),
        ({"preset": "Done the day before", "reason": " by Emmy "}, "Done the day before: by Emmy"),
        ({"preset": "", "reason": "the wires were lent out"}, "the wires were lent out"),
        ({"reason": "without a choice"}, "without a choice"),
    ],
)
def test_what_is_recorded_is_the_full_text(web: WebSite, fields: dict[str, str], recorded: str) -> None:
    bench, browser = begin(web, OWN)
    assert skip(bench, browser, **fields) == 303
    assert [p.reason for p in bench.payloads(OperatorAction)] == [recorded]
    assert recorded in browser.get(f"/runs/{bench.run_id}").text  # among the deviations


def test_neither_a_choice_nor_words_are_no_reason(web: WebSite) -> None:
    bench, browser = begin(web, OWN)
    assert skip(bench, browser, preset="", reason="  ") == 409
    assert bench.payloads(OperatorAction) == []


def test_an_empty_reason_in_a_protocol_is_refused() -> None:
    assert load(f"{TOY}\nreasons: {{redo: [Blurred images]}}\n").protocol.reasons.redo == ("Blurred images",)
    with pytest.raises(ProtocolError, match="reasons"):
        load(f'{TOY}\nreasons: {{redo: [""]}}\n')
    with pytest.raises(ProtocolError, match="reasons"):
        load(f"{TOY}\nreasons: {{pause: [Lunch]}}\n")
