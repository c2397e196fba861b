"""Gates: measured numbers judged against their limits."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from typing import Literal

from service.core.gates.measure_names import measure_name
from service.core.protocol.models import Gate, Step
from service.core.records.events import GatesEvaluated, GateVerdict, Uncertainty

BOUNDS_HOLD = (
    "The two numbers after a value are its lower and upper bound, each one-sided with 99 % confidence. The value is "
    "within its limits when both bounds are, outside when everything between them is, and undecided otherwise"
)
_LARGEST_WHOLE = 1e7
_UNITS_IN_S = ("s", "ms", "µs")  # other units that end in s are plurals: images, views, spheres


def evaluate_gates(
    step: Step,
    attempt: int,
    measures: Mapping[str, float],
    skipped: Collection[str] = (),
    uncertainties: Mapping[str, Uncertainty] | None = None,
) -> GatesEvaluated:
    """Judge every gate of a step. A measure that is missing or not a finite number fails.

    A measure with an uncertainty passes when its whole interval is within the limits, fails when its whole interval
    is outside, and is undecided otherwise; a step with an undecided gate has not passed.

    Args:
        step: the step with its gates.
        attempt: the attempt that measured.
        measures: the value of each measure, in the unit of its gate.
        skipped: identifiers of skipped steps. A gate that names one in `unless_skipped` is not judged, because the
            number does not exist without that step. The skip and its reason are in the record.
        uncertainties: the uncertainty of each measure, where one is known.
    """
    gates = [gate for gate in step.gates if gate.unless_skipped is None or gate.unless_skipped not in skipped]
    verdicts = judge(gates, measures, uncertainties)
    passed = all(verdict.passed for verdict in verdicts)
    return GatesEvaluated(step=step.id, attempt=attempt, verdicts=verdicts, passed=passed)


def judge(
    gates: Iterable[Gate], measures: Mapping[str, float], uncertainties: Mapping[str, Uncertainty] | None = None
) -> tuple[GateVerdict, ...]:
    """Judge measures by gates, as `evaluate_gates` judges those of a step."""
    known = uncertainties or {}
    return tuple(_verdict(gate, measures.get(gate.measure), known.get(gate.measure)) for gate in gates)


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
    """Return the outcome of a gate; `accepted` says that a person let the step pass with its figures as they are."""
    if verdict.passed:
        return "within"
    if accepted:
        return "accepted"
    return "not_decided" if verdict.undecided else "outside"


def describe(verdict: GateVerdict) -> str:
    """Return a figure and its limit in one line: `RMS reprojection error 0.71 px, allowed ≤ 0.5`."""
    name = measure_name(verdict.measure)
    text = f"{name} {figure(verdict)}" if verdict.value is not None else f"{name} was not measured"
    return f"{text}, allowed {limits(verdict.minimum, verdict.maximum)}"


def describe_judged(verdict: GateVerdict) -> str:
    """Return `describe`, with `: not decided` after an undecided verdict, for a line that stands alone."""
    return describe(verdict) + (": not decided" if verdict.undecided else "")


def figure(verdict: GateVerdict) -> str:
    """Return a verdict's value: `0.71 px`, or with its 99 % bounds `0.52 mm, 0.41 to 0.63` (see BOUNDS_HOLD)."""
    if verdict.value is None or verdict.lower is None or verdict.upper is None:
        return quantity(verdict.value, verdict.unit)
    return uncertain(verdict.value, verdict.lower, verdict.upper, verdict.unit)


def uncertain(value: float, lower: float, upper: float, unit: str = "") -> str:
    """Return a value with its bounds, `0.52 mm, 0.41 to 0.63`, and enough decimal places to distinguish them."""
    places = _places(upper - lower)
    return f"{value:.{places}f} {unit}".rstrip() + f", {lower:.{places}f} to {upper:.{places}f}"


def quantity(value: float | None, unit: str = "") -> str:
    """Return a number with its unit, for people: `8 images`, `1 image`, `0.71 px`; `not measured` for None."""
    if value is None:
        return "not measured"
    unit = unit_of(value, unit)
    text = f"{value:.0f}" if value == int(value) and abs(value) < _LARGEST_WHOLE else f"{value:.4g}"
    return f"{text} {unit}".rstrip()


def unit_of(value: float, unit: str) -> str:
    """Return the unit as it is written behind a number: `image` behind 1, and `images` behind all others."""
    return unit[:-1] if value == 1 and unit.endswith("s") and unit not in _UNITS_IN_S else unit


def _places(apart: float) -> int:
    return 2 if apart <= 0 else min(max(1 - math.floor(math.log10(apart)), 0), 4)


def limits(minimum: float | None, maximum: float | None) -> str:
    """Return limits as text: `≥ 0.2 and ≤ 1`, or `exactly 0`; None means no limit on that side."""
    if minimum is not None and minimum == maximum:
        return f"exactly {minimum:g}"
    low = "" if minimum is None else f"≥ {minimum:g}"
    high = "" if maximum is None else f"≤ {maximum:g}"
    return " and ".join(limit for limit in (low, high) if limit)
