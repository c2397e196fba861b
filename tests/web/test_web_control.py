"""Asking for control, refusing it and taking it over, as the other person sees it."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest

from service.web.run import newest
from tests.support.pages.browsed_run import words
from tests.support.pages.forms import forms_of
from tests.support.pages.web import Browser, WebSite, web_site


@dataclass
class Table:
    """Grace has control of a run; Emmy, a supervisor, looks on from her own screen."""

    web: WebSite
    run: str
    grace: Browser
    emmy: Browser

    def control(self, browser: Browser) -> str:
        """What the page says about control, with what screen readers are told."""
        answer = browser.get(f"/runs/{self.run}/parts/control")
        assert answer.status_code == 200
        return answer.text

    def press(self, browser: Browser, address: str, **entered: str) -> None:
        """Send the first form of that address as the page has it."""
        html = browser.get(f"/runs/{self.run}/parts/control,dialogs").text
        form = next(form for form in forms_of(html) if form.action.endswith(address))
        answer = browser.post(form.action, data=form.sent(**entered), follow_redirects=False)
        assert answer.status_code == 303, answer.text


@pytest.fixture
def table(tmp_path: Path) -> Generator[Table]:
    with web_site(tmp_path) as web:
        run = web.begin_run().run_id
        web.site.launcher.start(run)
        grace, emmy = web.browser("technician"), web.browser("supervisor")
        web.take_control(run, grace)
        yield Table(web, run, grace, emmy)


def test_asking_refusing_and_asking_again_are_news_to_every_open_page(table: Table) -> None:
    told = [newest(table.web.site, table.run)]
    table.press(table.emmy, "control/ask")
    told.append(newest(table.web.site, table.run))
    table.press(table.grace, "control/answer", grant="false")
    told.append(newest(table.web.site, table.run))
    table.press(table.emmy, "control/ask")
    told.append(newest(table.web.site, table.run))
    assert all(before != after for before, after in pairwise(told)), told


def test_the_notice_gives_the_name_of_who_asks(table: Table) -> None:
    table.press(table.emmy, "control/ask")
    said = table.control(table.grace)
    assert "Emmy Noether asks to take over control of this run." in words(said)
    assert 'data-news="Emmy Noether asks to take over control."' in said
    third = table.web.browser("supervisor")
    answer = third.send_form(f"/runs/{table.run}/control/ask", holder=table.grace.person.screen)
    assert answer.status_code == 409
    assert "Emmy Noether has just asked" in words(answer.text)


@pytest.mark.parametrize("page", ["capture", "held", "scene"])
def test_who_asks_is_said_on_the_other_pages_of_the_run_too(table: Table, page: str) -> None:
    table.press(table.emmy, "control/ask")
    assert "Emmy Noether asks to take over control. Answer" in words(
        table.grace.get(f"/runs/{table.run}/{page}").text
    )
    assert "asks to take over" not in words(table.emmy.get(f"/runs/{table.run}/{page}").text)
    table.press(table.grace, "control/answer", grant="false")
    assert "asks to take over" not in words(table.grace.get(f"/runs/{table.run}/{page}").text)


def test_a_refusal_reaches_the_one_who_asked_and_nobody_else(table: Table) -> None:
    table.press(table.emmy, "control/ask")
    assert "you have asked to take over and wait for an answer" in words(table.control(table.emmy))
    table.press(table.grace, "control/answer", grant="false")
    said = table.control(table.emmy)
    assert "Grace Hopper refused your request and keeps control of this run" in words(said)
    assert 'data-news="Grace Hopper did not hand over control."' in said
    assert "wait for an answer" not in words(said)
    assert "refused" not in words(table.control(table.web.browser("supervisor")))
    assert "refused" not in words(table.control(table.grace))
    table.press(table.emmy, "control/ask")
    assert "refused" not in words(table.control(table.emmy)), "the next request is open"


def test_a_refusal_is_over_when_control_changes(table: Table) -> None:
    table.press(table.emmy, "control/ask")
    table.press(table.grace, "control/answer", grant="false")
    table.press(table.emmy, "control/take", reason="Grace was called away")
    assert "refused" not in words(table.control(table.emmy))


def test_the_one_from_whom_control_was_taken_reads_by_whom_and_why(table: Table) -> None:
    table.press(table.emmy, "control/take", reason="the specimen <dries>")
    said = table.control(table.grace)
    assert "Emmy Noether took over control of this run from you" in words(said)
    assert "Reason: “the specimen <dries>”" in words(said)
    assert "<dries>" not in said
    assert 'data-news="Emmy Noether took over control of this run from you.' in said
    assert "took over" not in words(table.control(table.emmy))
    assert "took over" not in words(table.control(table.web.browser("auditor")))


def test_a_take_over_is_said_until_control_changes_again(table: Table) -> None:
    table.press(table.emmy, "control/take", reason="the specimen dries")
    table.web.people.sign_out(table.emmy.person)
    assert "Emmy Noether took over" in words(table.control(table.grace)), "who has gone since"
    table.press(table.grace, "control/take")
    again = Table(table.web, table.run, table.emmy, table.grace)
    assert "took over" not in words(again.control(table.grace))


def test_a_locked_screen_that_lost_control_reads_that_it_did_not_answer(table: Table) -> None:
    second = table.web.browser("supervisor")
    table.press(table.emmy, "control/ask")
    table.web.people.lock(table.grace.person)
    table.web.store.clock.sleep(61)
    html = table.emmy.get(f"/runs/{table.run}/parts/control").text
    take = next(form for form in forms_of(html) if form.action.endswith("control/take"))
    assert table.emmy.post(take.action, data=take.sent(), follow_redirects=False).status_code == 303
    assert "asked; the locked screen did not answer" in words(table.control(table.grace))
    assert "took over" not in words(table.control(second))
