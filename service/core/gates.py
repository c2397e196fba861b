"""Gates: measured figures against their limits, acceptance of others by a person, what depends on it, and release."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from service.core.errors import IllegalTransitionError
from service.core.measure_names import measure_name
from service.core.protocol import AcceptedBy, Gate, Protocol, Step
from service.core.records.run_events import GatesEvaluated, GateVerdict, OperatorAction, Uncertainty
from service.core.run.state import AcceptedDeviation, RunState, StepState
from service.core.words import counted

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


ROLE_OF: Mapping[AcceptedBy, str] = {"supervisor": "supervisor", "another_supervisor": "supervisor"}


def failed_gates(step: StepState) -> tuple[GateVerdict, ...]:
    """Return the verdicts of a step that did not pass: outside the limits, undecided or not measured."""
    return tuple(verdict for verdict in step.verdicts if not verdict.passed)


def acceptors(protocol: Protocol, state: RunState) -> frozenset[AcceptedBy]:
    """Return who may accept the failed gates of the current step by the protocol; empty when none failed."""
    by: dict[str, AcceptedBy | None] = {g.measure: g.accept_by for g in protocol.step(state.current).gates}
    found: set[AcceptedBy] = set()
    for verdict in failed_gates(state.step):
        asked = by.get(verdict.measure)
        if asked is not None:
            found.add(asked)
    return frozenset(found)


def demanded_role(protocol: Protocol, state: RunState) -> str:
    """Return the role that may accept the figures of the current step; "" when nobody may."""
    roles = sorted({ROLE_OF[by] for by in acceptors(protocol, state)})
    return roles[0] if roles and acceptance_refusal(protocol, state) is None else ""


def acceptance_refusal(protocol: Protocol, state: RunState) -> IllegalTransitionError | None:
    """Return the reason why nobody at all may accept the figures of the current step, or None."""
    step, now = protocol.step(state.current), state.step
    failed = failed_gates(now)
    if state.phase != "recovering" or now.failure is not None or not failed:
        return IllegalTransitionError("no figure of this step needs acceptance", where=step.id)
    if now.retry_granted:
        return IllegalTransitionError("the step is about to be tried again", where=step.id, remedy="Wait for it")
    by = {gate.measure: gate.accept_by for gate in step.gates}
    forbidden = [measure_name(verdict.measure) for verdict in failed if by.get(verdict.measure) is None]
    if forbidden:
        return IllegalTransitionError(
            f"the protocol allows nobody to accept {', '.join(forbidden)} outside the limits",
            where=step.id,
            remedy="Mend it, do the step again, or end the run here",
        )
    unmeasured = [measure_name(verdict.measure) for verdict in failed if verdict.value is None]
    if unmeasured:
        return IllegalTransitionError(
            f"{', '.join(unmeasured)} was not measured: there is nothing to judge",
            where=step.id,
            remedy="Do the step again",
        )
    return None


def acceptor_refusal(
    protocol: Protocol, state: RunState, action: OperatorAction, actor: str
) -> IllegalTransitionError | None:
    """Return the reason why this person may not accept the figures of the current step, or None."""
    if action.automatic or action.via in ("pedal", "auto"):
        return IllegalTransitionError(
            "only a person may accept figures outside their limits, by a signature", where=state.current
        )
    asked = acceptors(protocol, state)
    role = demanded_role(protocol, state)
    if action.role != role or not actor.strip():
        return IllegalTransitionError(
            f"only a {role} may accept these figures, with name and password",
            where=state.current,
            remedy="Call one; nothing is lost by waiting",
        )
    if "another_supervisor" in asked and actor in (state.operator, state.step.confirmed_by):
        return IllegalTransitionError(
            "the protocol asks for somebody other than the person who began the run or confirmed this step",
            where=state.current,
            remedy="Call another supervisor; nothing is lost by waiting",
        )
    return None


def describe_accepted(accepted: AcceptedDeviation) -> str:
    """Describe an acceptance: `coverage 0.896, allowed ≥ 0.9; accepted by Emmy (supervisor): the reason`."""
    figures = "; ".join(describe_judged(verdict) for verdict in accepted.verdicts)
    how = {"claimed": ", by claim", "pin": ", by PIN", "badge": ", by badge"}.get(accepted.identified, "")
    return f"{figures}; accepted by {accepted.by} ({accepted.role}{how}): {accepted.reason}"


@dataclass(frozen=True, slots=True)
class AcceptedGate:
    """An acceptance that a result depends on."""

    step: str
    title: str
    accepted: AcceptedDeviation

    @property
    def text(self) -> str:
        """`Camera calibration: coverage 0.896, allowed ≥ 0.9; accepted by …`."""
        return f"{self.title}: {describe_accepted(self.accepted)}"


def used_steps(protocol: Protocol, step: Step) -> frozenset[str]:
    """Return the earlier steps that a step's params name directly."""
    earlier = frozenset(protocol.step_ids[: protocol.index(step.id)])
    return earlier.intersection(_texts(step.params.model_dump(mode="json")))


def accepted_gates(protocol: Protocol, state: RunState) -> tuple[AcceptedGate, ...]:
    """Return every acceptance in force in a run, in the protocol's order."""
    found = ((step, state.steps[step.id].accepted) for step in protocol.steps)
    return tuple(AcceptedGate(step.id, step.title, accepted) for step, accepted in found if accepted is not None)


def depends_on(protocol: Protocol, state: RunState, step_id: str) -> tuple[AcceptedGate, ...]:
    """Return the acceptances that a step's result depends on: its own and, transitively, those of steps it uses."""
    reached: set[str] = set()
    waiting = [step_id]
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting += used_steps(protocol, protocol.step(name))
    return tuple(gate for gate in accepted_gates(protocol, state) if gate.step in reached)


def dependent_steps(protocol: Protocol, step_id: str) -> tuple[str, ...]:
    """Return the later steps that depend on this one, directly or not, in the protocol's order."""
    rests = {step_id}
    for step in protocol.steps[protocol.index(step_id) + 1 :]:
        if used_steps(protocol, step) & rests:
            rests.add(step.id)
    return tuple(name for name in protocol.step_ids if name in rests and name != step_id)


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for inner in value.values():
            yield from _texts(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _texts(inner)


# When the specimen of a run is freed, and when the run may be exported.
#
# A specimen is freed; a run is released, by a second person where the protocol asks for it, and its data with it.


_NAMED = 20  # deviations that the text of a release names; the record has the others


def release_meaning(state: RunState) -> str:
    """Return what a person declares who releases the run: that they read it, and with which deviations."""
    texts = [f"{one.kind.replace('_', ' ')}, {' '.join(one.text.split()).rstrip('.')}" for one in state.deviations]
    if not texts:
        return "I have read this run, in which nothing deviated from the protocol, and release it"
    more = f"; and {len(texts) - _NAMED} more" if len(texts) > _NAMED else ""
    named = "; ".join(texts[:_NAMED])
    return f"I have read this run and release it with its {counted(len(texts), 'deviation')}: {named}{more}"


def loses_release(protocol: Protocol, state: RunState, actor: str) -> bool:
    """Return whether a person who acts on the run now can no longer release it as the second person."""
    return protocol.release == "second_person" and not state.released_by and actor not in state.people


def refuse_release(state: RunState, actor: str, signed_sha256: str) -> IllegalTransitionError | None:
    """Return the reason why this person cannot release the run by signing this hash, or None."""
    if state.status != "completed":
        return IllegalTransitionError(
            f"the run is {state.status}", where="release", remedy="Only a completed run can be released"
        )
    if state.released_by:
        return IllegalTransitionError(f"{state.released_by} has released the run already", where="release")
    if actor in state.people:
        return IllegalTransitionError(
            f"{actor} took part in this run", where="release", remedy="A second person checks and releases it"
        )
    if signed_sha256 != state.completed_sha256:
        return IllegalTransitionError(
            "the signature is for a record other than the end of this run",
            where="release",
            remedy="Read the run again and sign it as it is now",
        )
    return None


def refuse_export(protocol: Protocol, state: RunState) -> IllegalTransitionError | None:
    """Return the reason why the run may not be exported yet, for want of a release, or None."""
    if protocol.release == "second_person" and not state.released_by:
        return IllegalTransitionError(
            "the protocol asks for a second person's release before anything is exported",
            where=state.run_id,
            remedy="A supervisor who took no part in the run reads it and signs its release, on the page or with "
            "`orthocapture audit release`",
        )
    return None


def refuse_data_set(state: RunState) -> IllegalTransitionError | None:
    """Return the reason why there is no data set of the run yet, or None."""
    if state.status != "completed":
        return IllegalTransitionError(
            f"the run is {state.status}", where=state.run_id, remedy="Only a completed run is exported"
        )
    return None


_ANSWERS = ("registrations", "accuracy")  # what must be known before a specimen is freed


def freed_utc(protocol: Protocol, state: RunState) -> str:
    """Return when the specimen was freed, so that nothing can be measured again (ISO 8601, UTC); "" before that.

    That is when the first irreversible step that requires a registration or an evaluation passed, or else the end of
    the run.
    """
    return _freed_by_step_utc(protocol, state) or (state.ended_utc if state.status == "completed" else "")


def late_s(protocol: Protocol, state: RunState, now_utc: str) -> float | None:
    """Return the seconds from `freed_utc` to a result that arrives at `now_utc`; None if it is in time."""
    freed = freed_utc(protocol, state)
    if not freed:
        return None
    return max(0.0, (datetime.fromisoformat(now_utc) - datetime.fromisoformat(freed)).total_seconds())


def late_words(protocol: Protocol, state: RunState, seconds: float) -> str:
    """Return a delay as text, such as `arrived 12 min after the specimen was freed`."""
    since = "the specimen was freed" if _freed_by_step_utc(protocol, state) else "the end of the run"
    minutes = round(seconds / 60)
    return f"arrived {minutes} min after {since}" if minutes else f"arrived after {since}"


def _freed_by_step_utc(protocol: Protocol, state: RunState) -> str:
    for step in protocol.steps:
        rests = any(protocol.step(name).gives in _ANSWERS for name in step.requires)
        if step.irreversible and rests and state.steps[step.id].phase == "passed":
            return state.steps[step.id].ended_utc
    return ""
