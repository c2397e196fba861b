"""Records build their validators at their first use (`defer_build`), and are as good as if they did it at once."""

from __future__ import annotations

import importlib
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from pydantic import BaseModel, ValidationError

from service.computations import job_kinds
from service.core.records.base import Record
from service.steps import step_kinds

THREADS = 8


def _derived(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    for one in model.__subclasses__():
        yield one
        yield from _derived(one)


def test_every_record_can_be_built() -> None:
    importlib.import_module("service.web.app")
    assert len(step_kinds()) > 10
    assert len(job_kinds()) > 20
    ours = [model for model in _derived(BaseModel) if model.__module__.startswith(("service.", "drivers."))]
    assert len(ours) > 250
    for model in ours:
        model.model_rebuild()
        assert model.__pydantic_complete__, model.__qualname__


def test_threads_may_use_a_record_first_at_the_same_time() -> None:
    # Without the lock of pydantic 2.14 some would use the validator of the base, which refuses every field.
    with ThreadPoolExecutor(THREADS) as pool:
        for _round in range(60):

            class Inner(Record):
                x: int

            class Outer(Record):
                inner: Inner
                many: tuple[Inner, ...] = ()

            together = threading.Barrier(THREADS)

            def use(number: int, together: threading.Barrier = together, outer: type[BaseModel] = Outer) -> str:
                together.wait(30)
                if number % 2:
                    return outer.model_validate({"inner": {"x": 1}, "many": [{"x": 2}]}).model_dump_json()
                return outer(inner={"x": 1}, many=[{"x": 2}]).model_dump_json()

            assert set(pool.map(use, range(THREADS))) == {'{"inner":{"x":1},"many":[{"x":2}]}'}


def test_they_refuse_what_others_refuse_in_the_same_words() -> None:
    class Deferred(Record):
        x: int

    class AtOnce(Record, defer_build=False):
        x: int

    said: list[str] = []
    for model in (AtOnce, Deferred):
        with pytest.raises(ValidationError) as caught:
            model.model_validate({"x": "a", "y": 1})
        said.append(str(caught.value).replace(model.__name__, "model"))
        said.append(str(model.model_json_schema()).replace(model.__name__, "model"))
    assert said[:2] == said[2:]
