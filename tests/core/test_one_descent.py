"""Nonlinear least squares is iterated in one module; a loop elsewhere is named here with its reason."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import service.compute

COMPUTE = Path(service.compute.__file__).parent

OWN_LOOPS = {
    "evaluation/closure.py": "chooses inliers before each step, and keeps the equations of the last",
    "markers/outlines/refine.py": "reweights equations that are linear",
}


def repeated_solves(source: str) -> int:
    """Number of loops without a counter of their own (`for _ in …`, `while …`) that solve linear equations."""
    return sum(
        _repeats(loop) and any(_solves(node) for node in ast.walk(loop)) for loop in ast.walk(ast.parse(source))
    )


def _repeats(node: ast.AST) -> bool:
    if isinstance(node, ast.For):
        return isinstance(node.target, ast.Name) and node.target.id == "_"
    return isinstance(node, ast.While)


def _solves(node: ast.AST) -> bool:
    return isinstance(node, ast.Call) and ast.unparse(node.func) in {"np.linalg.solve", "np.linalg.lstsq"}


def test_least_squares_is_iterated_in_one_module() -> None:
    found = {
        path.relative_to(COMPUTE).as_posix()
        for path in COMPUTE.rglob("*.py")
        if repeated_solves(path.read_text(encoding="utf-8"))
    }
    assert found == set(OWN_LOOPS), "use service/compute/descent.py (docs/decisions/0019-where-iterations-live.md)"


@pytest.mark.parametrize(
    ("source", "count"),
    [
        ("for _ in range(9):\n    x = x - np.linalg.solve(H, g)", 1),
        ("while True:\n    if far:\n        x = x - np.linalg.lstsq(J, r)[0]", 1),
        ("for one in many:\n    x = np.linalg.solve(one, g)", 0),
        ("x = np.linalg.solve(H, g)", 0),
    ],
)
def test_what_counts_as_a_loop(source: str, count: int) -> None:
    assert repeated_solves(source) == count
