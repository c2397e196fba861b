"""Fixtures of tests that run a protocol on the in-memory rig; the conftest of a folder imports them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.support.runs.bench_run import PROTOCOL, Bench, begin_run, bench_store


@pytest.fixture
def begin(tmp_path: Path) -> Iterator[Callable[[str], Bench]]:
    """Begins a run of a protocol's text."""
    with bench_store(tmp_path / "data") as store:
        yield lambda text: begin_run(store, text, tmp_path)


@pytest.fixture
def bench(begin: Callable[[str], Bench]) -> Bench:
    """A run of the usual protocol."""
    return begin(PROTOCOL)
