"""Gates: measured numbers against their limits."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Literal

from service.core.protocol.models import Gate, Step
from service.core.records.events import GatesEvaluated, GateVerdict, Uncertainty

BOUNDS_HOLD = (
    "Two numbers behind a value are the bounds that its own uncertainty leaves, each held with 99 %. It is within "
    "its limits when both bounds are, outside when all between them is, and not decided otherwise"
)
_LARGEST_WHOLE = 1e7
_UNITS_IN_S = ("s", "ms", "µs")  # the others that end with an s are plurals: images, views, spheres


def evaluate_gates(
    step: Step,
    attempt: int,
    measures: Mapping[str, float],
    skipped: Collection[str] = (),
    uncertainties: Mapping[str, Uncertainty] | None = None,
) -> GatesEvaluated:
    """Judge every gate of a step. A measure that is missing or not a finite number fails.

    A measure that states its uncertainty passes when all that it may be is within the limits, fails when nothing of
    it is, and is undecided otherwise: the step has not passed then.

    Args:
        skipped: identifiers of the skipped steps. A gate that names one of them in `unless_skipped` is not judged:
            without that step there is no such number. The skip, with its reason, is in the record.
        uncertainties: of those measures that state one.
    """
    gates = [gate for gate in step.gates if gate.unless_skipped is None or gate.unless_skipped not in skipped]
    verdicts = tuple(
        _verdict(gate, measures.get(gate.measure), (uncertainties or {}).get(gate.measure)) for gate in gates
    )
    passed = all(verdict.passed for verdict in verdicts)
    return GatesEvaluated(step=step.id, attempt=attempt, verdicts=verdicts, passed=passed)


def _verdict(gate: Gate, value: float | None, known: Uncertainty | None) -> GateVerdict:
    finite = value if value is not None and math.isfinite(value) else None  # canonical JSON has no NaN
    lower, upper = (finite, finite) if known is None else (known.lower, known.upper)
    within = outside = False
    if finite is not None and lower is not None and upper is not None:
        within = (gate.min is None or lower >= gate.min) and (gate.max is None or upper <= gate.max)
        outside = (gate.min is not None and upper < gate.min) or (gate.max is not None and lower > gate.max)
    stated = known if finite is not None else None
    return GateVerdict(
        measure=gate.measure,
        value=finite,
        minimum=gate.min,
        maximum=gate.max,
        unit=gate.unit,
        passed=within,
        sigma=None if stated is None else stated.sigma,
        lower=None if stated is None else stated.lower,
        upper=None if stated is None else stated.upper,
        undecided=finite is not None and not within and not outside,
    )


Standing = Literal["within", "not_decided", "accepted", "outside"]


def standing(verdict: GateVerdict, *, accepted: bool = False) -> Standing:
    """How a gate came out, for every reader. `accepted`: a person let the step pass with its figures as they are."""
    if verdict.passed:
        return "within"
    if accepted:
        return "accepted"
    return "not_decided" if verdict.undecided else "outside"


def describe(verdict: GateVerdict) -> str:
    """`rms 0.71 px, allowed ≤ 0.5`: a figure against its limit, in one line."""
    text = (
        f"{verdict.measure} {figure(verdict)}" if verdict.value is not None else f"{verdict.measure} was not measured"
    )
    return f"{text}, allowed {limits(verdict.minimum, verdict.maximum)}"


def describe_judged(verdict: GateVerdict) -> str:
    """The same of a gate that did not pass, where the line stands alone: it says so of a gate that is not decided."""
    return describe(verdict) + (": not decided" if verdict.undecided else "")


def figure(verdict: GateVerdict) -> str:
    """`0.71 px`, or `0.52 mm, 0.41 to 0.63` of a value that states its uncertainty (see BOUNDS_HOLD)."""
    if verdict.value is None or verdict.lower is None or verdict.upper is None:
        return quantity(verdict.value, verdict.unit)
    return uncertain(verdict.value, verdict.lower, verdict.upper, verdict.unit)


def uncertain(value: float, lower: float, upper: float, unit: str = "") -> str:
    """The same of any number with its bounds, with as many places as tell the bounds apart."""
    places = _places(upper - lower)
    return f"{value:.{places}f} {unit}".rstrip() + f", {lower:.{places}f} to {upper:.{places}f}"


def quantity(value: float | None, unit: str = "") -> str:
    """A number without bounds as people read it, with its unit: `8 images`, `1 image`, `0.71 px`, `not measured`."""
    if value is None:
        return "not measured"
    if value == 1 and unit.endswith("s") and unit not in _UNITS_IN_S:
        unit = unit[:-1]
    text = f"{value:.0f}" if value == int(value) and abs(value) < _LARGEST_WHOLE else f"{value:.4g}"
    return f"{text} {unit}".rstrip()


def _places(apart: float) -> int:
    return 2 if apart <= 0 else min(max(1 - math.floor(math.log10(apart)), 0), 4)


def limits(minimum: float | None, maximum: float | None) -> str:
    """`≥ 0.2 and ≤ 1`, or `= 0`."""
    if minimum is not None and minimum == maximum:
        return f"= {minimum:g}"
    low = "" if minimum is None else f"≥ {minimum:g}"
    high = "" if maximum is None else f"≤ {maximum:g}"
    return " and ".join(limit for limit in (low, high) if limit)
