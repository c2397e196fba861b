"""One object store for the tests of this folder that do not kill it."""

from __future__ import annotations

from collections.abc import Generator

import pytest

from tests.support.processes.object_store import Weed


@pytest.fixture(scope="module")
def weed(tmp_path_factory: pytest.TempPathFactory) -> Generator[Weed]:
    server = Weed(tmp_path_factory.mktemp("weed") / "server")
    server.start()
    yield server
    server.kill()
