"""The hands of a technician at the page of a run, who does what it asks for and knows nothing else."""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

from playwright.sync_api import Locator, expect
from playwright.sync_api import TimeoutError as PlaywrightTimeoutError

from tests.support.pages.accounts import PASSWORD
from tests.support.pages.browser import Screen
from tests.support.processes.waiting import until

MOST_MENDS = 4  # per step, as of the automatic operator
PRESSED_IN_VAIN = 3  # in the whole run
# What a page says of a stop after which the recommended way is to go on, once a person has looked.
_MENDED = ("What helps", "gave no sign of life", "Nobody has let the arm move since it was connected")
ANSWER_MS = 60_000  # after which the page does not answer a press any more


class Technician:
    """Reads the page and does the one thing that it asks for, without knowing the protocol."""

    def __init__(self, tablet: Screen) -> None:
        self.tablet, self.page = tablet, tablet.page
        self.held = self.signed = self.in_vain = 0
        self.mends: Counter[str] = Counter()  # title of a step → number of times its advice was followed

    def start(self, title: str) -> str:
        """Start a run of the protocol of this title; returns its id once it asks for something."""
        self.tablet.go("/")
        self.page.get_by_role("button", name=f"Start {title}").click()
        self.page.get_by_label("Specimen").fill("S1")
        self.page.get_by_role("button", name="Start the run").click()
        expect(self.page.get_by_role("checkbox").first).to_be_visible(timeout=ANSWER_MS)
        return self.page.url.rpartition("/")[2]

    def complete_the_run(self, step_s: float, log: Callable[[], str] = lambda: "") -> None:
        """Act until the run is complete; fail, with the page's text and the log, where a step hangs."""
        complete = self.page.get_by_role("heading", name="The run is complete")
        title = self.page.get_by_role("heading", level=1)
        missed = "nothing"

        def went_on(step: str) -> bool:
            nonlocal missed
            try:
                self.do_what_is_asked()
                return complete.count() > 0 or title.inner_text(timeout=5_000) != step
            except PlaywrightTimeoutError as error:  # the page changed meanwhile: look again
                missed = str(error)
                return False

        while complete.count() == 0:
            step = title.inner_text(timeout=ANSWER_MS)
            until(partial(went_on, step), lambda: f"{log()}\n{self.tablet.words()}\nmissed last: {missed}", step_s)

    def do_what_is_asked(self) -> None:
        """Tick, sign, confirm or hold, or follow advice; wait while the software works."""
        page = self.page
        trouble = page.locator(".notice-stop:has(dl)")  # what happened, and what helps
        if trouble.count():
            self._follow_advice(trouble)
            return
        unticked = page.locator("[role=checkbox][aria-checked=false]:not([disabled])")
        if unticked.count():
            before = unticked.count()
            unticked.first.click()
            expect(unticked).to_have_count(before - 1, timeout=ANSWER_MS)
            return
        actions = page.locator(".actions")
        sign = actions.get_by_role("button", name=re.compile("^Sign"))
        confirm = actions.get_by_role("button", name=re.compile("^(Confirm:|Take photograph)"))
        if sign.count() and sign.is_visible():
            self._sign(sign)
        elif confirm.count() and confirm.is_enabled(timeout=1_000):
            self._confirm(confirm)
        else:
            page.wait_for_timeout(400)

    def _follow_advice(self, trouble: Locator) -> None:
        """Try again where the page recommends it and says what helps; any other trouble is an error.

        On a busy machine the watchdog may stop the arm: the page says so, and that a person must permit motion again.
        """
        words = trouble.inner_text(timeout=1_000)
        recommended = self.page.locator("table.ways tbody tr").first.inner_text(timeout=1_000)
        assert any(known in words for known in _MENDED), words
        assert "Recommended" in recommended, words
        assert "with the large button below" in recommended, words
        step = self.page.get_by_role("heading", level=1).inner_text()
        self.mends[step] += 1
        assert self.mends[step] <= MOST_MENDS, words
        again = self.page.locator(".actions").get_by_role("button", name=re.compile("^Try again"))
        self._confirm(again)

    def _sign(self, sign: Any) -> None:
        asked = self._asked()
        sign.click()
        self.page.get_by_label("Your password").fill(PASSWORD)
        self.page.get_by_role("button", name="Sign", exact=True).click()
        expect(self.page.locator("dialog[open]")).to_have_count(0, timeout=ANSWER_MS)
        self.signed += 1
        self._until_something_else_is_asked(asked, lambda: sign.count() == 0)

    def _confirm(self, confirm: Any) -> None:
        asked = self._asked()
        if confirm.get_attribute("data-hold", timeout=1_000):
            confirm.hover()
            self.page.mouse.down()
            self.page.wait_for_timeout(1800)
            until(lambda: confirm.locator("xpath=self::*[contains(@class, 'held')]").count() == 0, "it was held")
            self.page.mouse.up()
            self.held += 1
        else:
            confirm.click(timeout=5_000)
        self._until_something_else_is_asked(
            asked, lambda: confirm.count() == 0 or not confirm.is_enabled(timeout=1_000)
        )

    def _asked(self) -> tuple[str, str]:
        """The step, and the offered actions; the question may change between two calls."""
        heading = self.page.get_by_role("heading", level=1).inner_text(timeout=5_000)
        return heading, self.page.locator(".actions").inner_text(timeout=5_000)

    def _until_something_else_is_asked(self, asked: tuple[str, str], gone: Callable[[], bool]) -> None:
        """Wait until another step comes, the same step asks for something else, or the page gives a reason.

        While a page on a busy machine has lost its connection, a press has no effect; the technician then presses
        again.
        """
        deadline_s = time.monotonic() + 20
        while self._asked() == asked and not gone() and not self.page.locator("#problem").is_visible():
            if time.monotonic() > deadline_s:
                self.in_vain += 1
                assert self.in_vain <= PRESSED_IN_VAIN, f"{asked}: {self.tablet.words()}"
                return
            self.page.wait_for_timeout(200)
