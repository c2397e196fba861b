"""One PostgreSQL server for the tests of a file that bring their own."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.support.processes.postgres import Cluster


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    made = Cluster(brief=True)
    made.start()
    yield made
    made.stop()
