"""Gates: measured numbers against their limits."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

from service.core.model import GatesEvaluated, GateVerdict
from service.core.protocol import Gate, Step


def evaluate_gates(
    step: Step, attempt: int, measures: Mapping[str, float], skipped: Collection[str] = ()
) -> GatesEvaluated:
    """Judge every gate of a step. A measure that is missing or not a finite number fails.

    Args:
        skipped: identifiers of the skipped steps. A gate that names one of them in `unless_skipped` is not judged:
            without that step there is no such number. The skip, with its reason, is in the record.
    """
    gates = [gate for gate in step.gates if gate.unless_skipped is None or gate.unless_skipped not in skipped]
    verdicts = tuple(_verdict(gate, measures.get(gate.measure)) for gate in gates)
    passed = all(verdict.passed for verdict in verdicts)
    return GatesEvaluated(step=step.id, attempt=attempt, verdicts=verdicts, passed=passed)


def _verdict(gate: Gate, value: float | None) -> GateVerdict:
    finite = value if value is not None and math.isfinite(value) else None  # canonical JSON has no NaN
    passed = (
        finite is not None and (gate.min is None or finite >= gate.min) and (gate.max is None or finite <= gate.max)
    )
    return GateVerdict(
        measure=gate.measure, value=finite, minimum=gate.min, maximum=gate.max, unit=gate.unit, passed=passed
    )


def describe(verdict: GateVerdict) -> str:
    """`rms 0.71 px, allowed ≤ 0.5`: one line for an operator."""
    value = "was not measured" if verdict.value is None else f"{verdict.value:.4g} {verdict.unit}".rstrip()
    return f"{verdict.measure} {value}, allowed {limits(verdict.minimum, verdict.maximum)}"


def limits(minimum: float | None, maximum: float | None) -> str:
    """`≥ 0.2 and ≤ 1`."""
    low = "" if minimum is None else f"≥ {minimum:g}"
    high = "" if maximum is None else f"≤ {maximum:g}"
    return " and ".join(limit for limit in (low, high) if limit)
