"""The page of a one-time link. tests/browser/test_browser_tablet.py checks in a browser that its code can be read."""

from __future__ import annotations

import re
from pathlib import Path

from tests.support.pages.web import web_site


def test_a_link_comes_as_text_to_copy_and_as_a_code(tmp_path: Path) -> None:
    with web_site(tmp_path) as web:
        given = {"account": "maria", "full_name": "Maria Meyer", "role": "technician"}
        answer = web.browser("administrator").send_form("/accounts", **given)
        page = answer.text
        (link,) = re.findall(r'id="one-time-link">([^<]+)<', page)
        (svg,) = re.findall(r"<svg[^>]*class=\"qr\".*?</svg>", page, re.DOTALL)
        assert 'data-copy="one-time-link"' in page
        assert "viewBox" in svg, "it scales as a whole"
        assert "style=" not in svg, "the content security policy forbids it"
        assert answer.headers["cache-control"] == "no-store"
        assert web.browser().get(link.removeprefix("https://testserver")).status_code == 200
