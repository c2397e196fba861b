"""Gates: measured numbers against their limits."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

from service.core.model import GatesEvaluated, GateVerdict, Uncertainty
from service.core.protocol import Gate, Step


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


def describe(verdict: GateVerdict) -> str:
    """`rms 0.71 px, allowed ≤ 0.5`: one line for an operator."""
    value = "was not measured" if verdict.value is None else figure(verdict)
    return f"{verdict.measure} {value}, allowed {limits(verdict.minimum, verdict.maximum)}"


def figure(verdict: GateVerdict) -> str:
    """`0.71 px`, or `0.52 mm, 0.41 to 0.63` of a value that states its uncertainty; empty where there is none."""
    if verdict.value is None:
        return ""
    within = bounds(verdict)
    text = f"{verdict.value:.{_places(verdict)}f}" if within else f"{verdict.value:.4g}"
    return f"{text} {verdict.unit}".rstrip() + within


def bounds(verdict: GateVerdict) -> str:
    """`, 0.41 to 0.63` after a value that states its uncertainty, with as many places as tell the bounds apart."""
    if verdict.lower is None or verdict.upper is None:
        return ""
    places = _places(verdict)
    return f", {verdict.lower:.{places}f} to {verdict.upper:.{places}f}"


def _places(verdict: GateVerdict) -> int:
    apart = 0.0 if verdict.lower is None or verdict.upper is None else verdict.upper - verdict.lower
    return 2 if apart <= 0 else min(max(1 - math.floor(math.log10(apart)), 0), 4)


def limits(minimum: float | None, maximum: float | None) -> str:
    """`≥ 0.2 and ≤ 1`."""
    low = "" if minimum is None else f"≥ {minimum:g}"
    high = "" if maximum is None else f"≤ {maximum:g}"
    return " and ".join(limit for limit in (low, high) if limit)
