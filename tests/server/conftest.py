"""The site and the run of this folder's tests."""

from __future__ import annotations

from collections.abc import Generator

import pytest

from tests.support.pages.web import WebSite, web_site


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Generator[WebSite]:
    with web_site(tmp_path_factory.mktemp("security")) as site:
        yield site


@pytest.fixture(scope="module")
def run_id(site: WebSite) -> str:
    return site.record_run()
