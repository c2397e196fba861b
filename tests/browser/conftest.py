"""The browser of this folder's tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from tests.support.pages.browser import chromium


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of this folder: they drive Chromium."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.packages("chromium"))


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """Chromium, started once for the files of this folder that a process runs one after another.

    It does not outlive them: Playwright keeps an event loop, beside which other tests could not run theirs.
    """
    with chromium() as running:
        yield running
