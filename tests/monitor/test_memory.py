"""A full collection in the runner's process visits only what is new, so that no heartbeat is missed during one."""

from __future__ import annotations

import gc

import pytest

from service.runner.upkeep import short_collections
from tests.support.runs.bench_run import Bench


class _Cycle:
    def __init__(self) -> None:
        self.itself = self


def test_what_survived_a_collection_is_not_visited_by_the_next() -> None:
    with short_collections():
        kept = [[number] for number in range(50_000)]
        gc.collect()
        assert len(gc.get_objects()) < len(kept)
        more = [[number] for number in range(20_000)]
        assert any(found is more[0] for found in gc.get_objects())
        gc.collect()
        assert len(gc.get_objects()) < len(more)


def test_new_cycles_are_collected() -> None:
    with short_collections():
        for _ in range(3):
            _Cycle()
            gc.collect()
        assert not any(isinstance(found, _Cycle) for found in gc.get_objects())


def test_afterwards_everything_is_visited_as_before() -> None:
    callbacks = list(gc.callbacks)
    with short_collections():
        kept = [[number] for number in range(1000)]
        gc.collect()
    assert gc.callbacks == callbacks
    assert gc.get_freeze_count() == 0
    assert any(found is kept[0] for found in gc.get_objects())


def test_a_run_is_driven_so(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    frozen: list[int] = []
    told = bench.operator.tell

    def tell(words: str) -> None:
        frozen.append(gc.get_freeze_count())
        told(words)

    monkeypatch.setattr(bench.operator, "tell", tell)
    assert bench.run().status == "completed"
    assert frozen
    assert min(frozen) > 0
