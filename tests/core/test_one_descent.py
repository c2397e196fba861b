"""Nonlinear least squares is iterated in one module; a loop elsewhere is named here with its reason."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import service.compute

COMPUTE = Path(service.compute.__file__).parent
SOLVE = {"np.linalg.solve", "np.linalg.lstsq"}
DESCENT = {"gauss_newton", "halved_gauss_newton", "levenberg_marquardt"}

OWN_LOOPS = {
    "registration/accuracy.py": "chooses inliers before each step, and keeps the equations of the last",
    "markers/limb.py": "estimates noise, selection and priors again before each step",
    "markers/refine.py": "reweights equations that are linear",
    "sfm/hybrid.py": "solves once for each camera, and iterates nothing",
    "sfm/features.py": "reweights equations that are linear, for the start of a descent",
    "registration/solve.py": "whitens residuals, to reweight the next descent",
    "surfaces/constellations.py": "removes one outlier at a time, and tests each against a fit of the others",
    "surfaces/sphere_candidates.py": "does the same for hundreds of candidates at once",
    "surfaces/sphere_fit.py": "shrinks the band of samples with the residuals",
}


def repeated_solves(source: str) -> int:
    """Number of loops over a range or a condition that solve linear equations, or call a function that does."""
    tree = ast.parse(source)
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    solvers = {one.name for one in functions if _calls(one) & SOLVE and not _calls(one) & DESCENT}
    return sum(_repeats(loop) and bool(_calls(loop) & (SOLVE | solvers)) for loop in ast.walk(tree))


def _repeats(node: ast.AST) -> bool:
    if isinstance(node, ast.For):
        return isinstance(node.iter, ast.Call) and ast.unparse(node.iter.func) == "range"
    return isinstance(node, ast.While)


def _calls(node: ast.AST) -> set[str]:
    return {ast.unparse(call.func) for call in ast.walk(node) if isinstance(call, ast.Call)}


@pytest.mark.slow
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
        ("def step(x):\n    return np.linalg.solve(x, g)\nfor it in range(9):\n    x = x - step(x)", 1),
        ("for one in many:\n    x = np.linalg.solve(one, g)", 0),
        ("x = np.linalg.solve(H, g)", 0),
    ],
)
def test_what_counts_as_a_loop(source: str, count: int) -> None:
    assert repeated_solves(source) == count
