"""A run as a person looks at it in the browser, and the words of a page."""

from __future__ import annotations

import re
from dataclasses import dataclass
from html import unescape
from typing import Any

from tests.support.pages.web import Browser, WebSite


@dataclass(frozen=True)
class BrowsedRun:
    """A run, and a person who looks at its pages."""

    site: WebSite
    browser: Browser
    run: str

    def html(self, address: str = "capture", **query: Any) -> str:
        answer = self.browser.get(f"/runs/{self.run}/{address}", params=query)
        assert answer.status_code == 200, answer.text
        return answer.text

    def words(self, address: str = "capture", **query: Any) -> str:
        return words(self.html(address, **query))


def words(html: str) -> str:
    """The text of a page, without its tags."""
    return re.sub(r"\s+", " ", unescape(re.sub(r"<[^>]+>", " ", html)))
