"""Leaves out the tests that cost more CPU seconds than a limit, by the list tests/cpu_seconds.json.

`pytest --cpu-below SECONDS`: the mutants try more tests than `make test` runs (bench/suite/mutants), and not those of
whole processes.
"""

from __future__ import annotations

import pytest

from tests.plugins.collecting import Costs, listed_name


class CostLimit:
    """The plug-in: deselects the tests at the limit and above; one that is not on the list is kept."""

    def __init__(self, limit_s: float, costs: Costs) -> None:
        self._limit_s, self._costs = limit_s, costs

    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        """Deselect what costs too much."""
        config.hook.pytest_deselected(items=[item for item in items if self._cost_s(item) >= self._limit_s])
        items[:] = [item for item in items if self._cost_s(item) < self._limit_s]

    def _cost_s(self, item: pytest.Item) -> float:
        file, name = listed_name(item.nodeid)
        return self._costs.get(file, {}).get(name, 0.0)
