"""A large run and its pages, for this folder's tests."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import pytest

from service.store.store import Store
from tests.support.pages.web import WebSite, web_site
from tests.support.recorded.large_run import SMALL, write_large_run


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder with one run in which nearly everything has happened."""
    folder = tmp_path_factory.mktemp("large")
    write_large_run(folder / "data", SMALL)
    return folder


@pytest.fixture(scope="module")
def store(large: Path) -> Generator[Store]:
    with Store.open(large / "data") as opened:
        yield opened


@pytest.fixture(scope="module")
def run(store: Store) -> str:
    return store.runs()[0].run_id


@pytest.fixture(scope="module")
def web(large: Path) -> Generator[WebSite]:
    with web_site(large) as site:
        yield site
