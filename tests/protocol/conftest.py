"""The site of this folder's tests."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import pytest

from tests.support.pages.web import WebSite, web_site


@pytest.fixture
def web(tmp_path: Path) -> Generator[WebSite]:
    with web_site(tmp_path) as site:
        yield site
