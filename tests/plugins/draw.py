"""Draws a tenth of the tests that are too many to run each time: whole runs, and rows of systematic sweeps.

`pytest --draw SEED` keeps every test but those marked `whole` or `sweep`, of which it keeps a tenth, chosen by the
seed (continuous integration gives the commit's hash), and prints which. Of every matrix, however small, at least one
row runs. Tests and rows marked `whole(always=True)` or `sweep(always=True)` are kept whatever the seed, and those
marked `whole(drawn=False)` never. Without `--draw` all of them run.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Container, Iterable

import pytest

ONE_IN = 10


def drawn(seed: str, units: Iterable[str]) -> set[str]:
    """Return a tenth of `units`, at least one, in an order that the hash of seed and unit decides.

    >>> len(drawn("a", [f"test_{i}" for i in range(40)]))
    4
    """
    ranked = sorted(set(units), key=lambda unit: hashlib.sha256(f"{seed}\n{unit}".encode()).digest())
    return set(ranked[: max(1, round(len(ranked) / ONE_IN))])


def drawn_rows(seed: str, rows: Iterable[str], covered: Container[str] = ()) -> set[str]:
    """Return a tenth of the rows, of each parametrised test at least one, unless it is one of those `covered`.

    These have rows that always run. Their other rows are drawn together with the tests that have no parameters.

    >>> large, small = [f"t.py::large[{i}]" for i in range(30)], ["t.py::small[a]", "t.py::small[b]"]
    >>> others = [*(f"t.py::covered[{i}]" for i in range(6)), *(f"t.py::single_{i}" for i in range(6))]
    >>> chosen = drawn_rows("a", [*large, *small, *others], {"t.py::covered"})
    >>> [len(chosen & set(rows)) for rows in (large, small, others)]
    [3, 1, 1]
    """
    matrices: dict[str, list[str]] = defaultdict(list)
    for row in rows:
        test, bracket, _ = row.partition("[")
        matrices[test if bracket and test not in covered else ""].append(row)
    return {row for matrix in matrices.values() for row in drawn(seed, matrix)}


class Draw:
    """The plug-in: deselects what was not drawn, and says what was."""

    def __init__(self, seed: str) -> None:
        self._seed = seed
        self._kept: dict[str, tuple[int, list[str]]] = {}

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        """Deselect what was not drawn: whole runs by file, since a file's tests share one; sweeps row by row."""
        left_out: set[pytest.Item] = set()
        units: dict[str, dict[str, list[pytest.Item]]] = {"whole": {}, "sweep": {}}
        covered: set[str] = set()
        for item in items:
            mark = next(filter(None, map(item.get_closest_marker, units)), None)
            if mark is not None and not mark.kwargs.get("drawn", True):
                left_out.add(item)
            elif mark is None or mark.kwargs.get("always", False):
                covered.add(item.nodeid.partition("[")[0])
            else:
                unit = item.nodeid.partition("::")[0] if mark.name == "whole" else item.nodeid
                units[mark.name].setdefault(unit, []).append(item)
        for mark, of_mark in units.items():
            kept = drawn(self._seed, of_mark) if mark == "whole" else drawn_rows(self._seed, of_mark, covered)
            self._kept[mark] = (len(of_mark), sorted(kept))
            left_out.update(item for unit, members in of_mark.items() if unit not in kept for item in members)
        config.hook.pytest_deselected(items=[item for item in items if item in left_out])
        items[:] = [item for item in items if item not in left_out]

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Say which were drawn."""
        for mark, (count, kept) in self._kept.items():
            terminalreporter.section(f"drawn by {self._seed}: {len(kept)} of {count} marked {mark}")
            for unit in kept:
                terminalreporter.line(unit)
