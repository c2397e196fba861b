"""After a calibration that fails a gate: plans the further board poses that would make it pass."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from service.compute.board.design import PlanPrediction
from service.core.gates.verdict import describe, evaluate_gates
from service.core.records.events import GateVerdict
from service.core.text.counts import counted
from service.steps.board.capture import BoardCapture
from service.steps.capture.retakes import TAKEN_AGAIN
from service.steps.context import StepContext

_MOST = 30  # most further poses in one attempt
_AGAIN = 10  # further poses if their number cannot be predicted
_AIM = 0.9  # share of a limit to reach, because predictions may be slightly optimistic
_SPARE = 0.03  # added to a required coverage, because a corner may miss its predicted cell

Enough = Callable[[PlanPrediction, PlanPrediction], bool]


def mend_calibration(context: StepContext, capture: BoardCapture, measures: Mapping[str, float]) -> None:
    """If a gate fails, plan and note further poses; the retry takes them and keeps the good images."""
    verdicts = evaluate_gates(context.step, context.attempt, measures, context.run.skipped).verdicts
    failed = [verdict for verdict in verdicts if not verdict.passed]
    if not failed:
        return
    short = "; ".join(describe(verdict) for verdict in failed)
    again = [word for name, word in TAKEN_AGAIN.items() if name in {v.measure for v in failed}]
    by_poses = [verdict for verdict in failed if verdict.measure not in TAKEN_AGAIN]
    if by_poses:
        count, rules = _wanted(by_poses, measures)

        def advise(found: int, names: str, words: str) -> str:
            first = f"First {' and '.join(again)}. " if again else ""
            return (
                f"{short}. {first}Confirm to take {counted(found, 'more image', 'more images')} of the board "
                f"({names}); all others are kept. Prediction with them: {words}"
            )

        if capture.mend(count, lambda before, after: all(rule(before, after) for rule in rules), advise):
            return
    if again:
        advice = f"{short}. First {' and '.join(again)}; then confirm, and the affected images are taken again"
    else:
        advice = (
            f"{short}. The arm can reach no further pose that shows the whole board: lay the board where the arm can "
            "reach more poses around it, and redo the step"
        )
    context.note("advice", advice=advice)
    context.tell(advice)


def _wanted(failed: Sequence[GateVerdict], measures: Mapping[str, float]) -> tuple[int, list[Enough]]:
    """The most poses to add, and the rules that say when they are enough."""
    least, most, rules = 1, _MOST, list[Enough]()
    for verdict in failed:
        name, value = verdict.measure, verdict.value
        low, high = verdict.minimum, verdict.maximum
        if name == "views" and value is not None and low is not None:
            least = max(least, round(low - value))
        elif name in _PREDICTED and (low is not None or (high is not None and value)):
            rules.append(_rule(name, value, low, high))
        else:  # an error that decreases with more images
            least = max(least, _AGAIN)
    return max(most, least), [lambda before, after: after.images - before.images >= least, *rules]


def _rule(name: str, value: float | None, low: float | None, high: float | None) -> Enough:
    """A rule: whether a predicted number reaches the gate.

    For uncertainties, the measured value is scaled by the predicted ratio of after to before.
    """
    of = _PREDICTED[name]
    if low is not None:
        least = min(1.0, low + _SPARE) if name == "coverage" else low
        return lambda _before, after: of(after) >= least
    assert high is not None
    assert value is not None
    return lambda before, after: value * of(after) / of(before) <= _AIM * high


_PREDICTED: Mapping[str, Callable[[PlanPrediction], float]] = {
    "coverage": lambda p: p.coverage,
    "tilt_deg": lambda p: p.tilt_deg - 0.5,
    "rotation_spread_deg": lambda p: p.rotation_spread_deg - 0.5,
    "uncertainty_mm": lambda p: p.uncertainty_mm,
    "uncertainty_px": lambda p: p.uncertainty_mm,
    "uncertainty_centre_mm": lambda p: p.uncertainty_mm,
    "hand_eye_sigma_mm": lambda p: p.hand_eye_sigma_mm,
    "hand_eye_sigma_deg": lambda p: p.hand_eye_sigma_deg,
}
