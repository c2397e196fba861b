"""The people of this folder's tests."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import pytest

from service.people.sessions import People
from service.store.store import Store
from tests.support.pages.web import QUICK_HASHES, populate
from tests.support.record.office import Office
from tests.support.record.stepped_clock import SteppedClock


@pytest.fixture
def office(tmp_path: Path) -> Generator[Office]:
    clock = SteppedClock()
    with Store.open(tmp_path / "data", clock) as store:
        people = People(store, QUICK_HASHES)
        populate(people)
        yield Office(people, store, clock, tmp_path / "data")
