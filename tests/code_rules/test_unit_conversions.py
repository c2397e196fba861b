"""No module converts a unit itself: service/core/units.py does it, and simulators/units.py for the simulators."""

from __future__ import annotations

import ast

import pytest

from tests.support.rig.rig import REPOSITORY

_POWERS = {1e-6, 1e-3, 1e3, 1e6, 1e9}
_UNITS = ("service/core/units.py", "simulators/units.py")
# Products with such a constant that convert nothing → what they are.
_ALLOWED = {
    "1e-06 * np.eye(2)": "damping of a least-squares step",
    "1000 * result.coverage": "a share in tenths of a percent, to be rounded down",
    "0.001 * np.sin(phase)": "an amplitude in metres",
    "1000 * distance_m": "of the bundle's verifier, which imports nothing of this project",
}


@pytest.mark.slow
def test_units_are_converted_in_one_place_only() -> None:
    found = {
        (path.relative_to(REPOSITORY).as_posix(), expression)
        for folder in ("service", "drivers", "simulators")
        for path in (REPOSITORY / folder).rglob("*.py")
        for expression in conversions(path.read_text(encoding="utf-8"))
    }
    inline = {place for place in found if place[0] not in _UNITS and place[1] not in _ALLOWED}
    assert not inline, f"convert these in one of {_UNITS}: {sorted(inline)}"
    assert _ALLOWED.keys() <= {expression for _, expression in found}, "an exception is no longer needed"


def test_conversions_are_seen_in_every_form() -> None:
    text = "a = 1e3 * x\nb = x / 1000\nc *= 0.001\nd = x * 1000.0 * y\ne = 2 * x\nf = 1000 + x\n"
    assert conversions(text) == ["1000.0 * x", "x / 1000", "c *= 0.001", "x * 1000.0"]


def conversions(source: str) -> list[str]:
    """The products and quotients of a module in which a power of a thousand is a factor, in order of the lines."""
    nodes = ast.walk(ast.parse(source))
    found = [node for node in nodes if isinstance(node, ast.BinOp | ast.AugAssign) and _converts(node)]
    return [ast.unparse(node) for node in sorted(found, key=lambda node: (node.lineno, node.col_offset))]


def _converts(node: ast.BinOp | ast.AugAssign) -> bool:
    factors = (node.left, node.right) if isinstance(node, ast.BinOp) else (node.value,)
    return isinstance(node.op, ast.Mult | ast.Div) and any(map(_is_power, factors))


def _is_power(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and type(node.value) in (int, float) and node.value in _POWERS
