"""The course of a run: deviations from the protocol, steps and gates, and who did and signed what."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from service.audit.overview.digest import Shots, failed_exposures, shots_by_step
from service.audit.record.run import RecordedRun
from service.audit.report.blocks import (
    Block,
    Column,
    Paragraph,
    Section,
    Table,
    TableCell,
    clock,
    duration,
    judged,
    limit,
    measured,
    utc,
    words,
)
from service.core.gates import BOUNDS_HOLD, describe_judged
from service.core.records.run_events import (
    DeviceTrouble,
    GatesEvaluated,
    LeaveLapsed,
    OperatorAction,
    RecordCorrected,
    RobotSeen,
    RunReleased,
    StepFailed,
    ViewpointFailed,
)
from service.core.run.state import StepState
from service.core.words import counted


@dataclass(frozen=True, slots=True)
class NotableEvent:
    """A text on an event that a reader must know of."""

    seq: int
    kind: str
    step: str
    text: str
    who: str


def deviations(run: RecordedRun) -> list[NotableEvent]:
    """Return the deviations of the run, accepted gates first, then in the order of their events."""
    titles = {step.id: step.title for step in run.protocol.steps}
    found = [
        NotableEvent(d.seq, words(d.kind), titles.get(d.step or "", ""), d.text, d.actor)
        for d in run.state.deviations
    ]
    return sorted(found, key=lambda departure: (departure.kind != words("gate_accepted"), departure.seq))


def incidents(run: RecordedRun) -> list[NotableEvent]:
    """List what a reader must know that is no deviation: failed gates, faults, corrections, what was not done."""
    titles = {step.id: step.title for step in run.protocol.steps}
    found: list[NotableEvent] = []
    for event in run.events:
        found += [
            NotableEvent(event.seq, kind, titles.get(step, ""), text, event.actor)
            for kind, step, text in _of_event(event.payload)
        ]
    last = run.events[-1].seq
    for step in run.protocol.steps:
        state = run.state.steps[step.id]
        if step.sign and state.phase == "passed" and not state.skipped and not state.signed:
            found.append(NotableEvent(last, "unsigned", step.title, "nobody has signed this step", ""))
        elif state.phase != "passed":
            found.append(NotableEvent(last, "not done", step.title, f"the step is {words(state.phase)}", ""))
    return found


def _of_event(payload: object) -> Iterator[tuple[str, str, str]]:
    match payload:
        case GatesEvaluated(passed=False):
            for verdict in payload.verdicts:  # each counts, as on the auditor's pages
                if not verdict.passed:
                    kind = "gate not decided" if verdict.undecided else "gate failed"
                    yield kind, payload.step, f"attempt {payload.attempt}: {describe_judged(verdict)}"
        case StepFailed():
            yield "step failed", payload.step, f"attempt {payload.attempt}: {payload.message}"
        case ViewpointFailed(skipped=False):
            yield "exposure failed", payload.step, f"{payload.viewpoint}: {payload.message}"
        case DeviceTrouble():
            yield "device", "", f"{payload.device}: {payload.message}"
        case LeaveLapsed():
            held = f"no visible progress for {payload.idle_s:.0f} s, a confirmation holds for {payload.limit_s:.0f} s"
            yield "confirmation lapsed", "", f"{held}: {payload.why}" if payload.why else held
        case RobotSeen():
            yield "arm looked at", "", f"{payload.device}: somebody looked at it after its connection was lost"
        case RecordCorrected():
            text = f"event {payload.of_seq}, {payload.field}: {payload.old!r} → {payload.new!r}; {payload.reason}"
            yield "correction", "", text
        case _:
            return


def deviations_section(run: RecordedRun, listed: Sequence[NotableEvent]) -> Section:
    """Return the deviations; then what else happened, and the number of replaced attempts and views."""
    blocks: list[Block] = [_table(run, listed) if listed else _none(run)]
    others = incidents(run)
    if others:
        told = (
            "The table below is not of deviations. It lists gates that failed in some attempt, faults, corrections "
            "of the record, and steps that were not done."
        )
        blocks += [Paragraph(told), _table(run, others)]
    automatic = len(run.state.automatic)
    if automatic:
        were = "was" if automatic == 1 else "were"
        text = f"{counted(automatic, 'confirmation')} {were} given automatically, which only a simulated rig allows."
        blocks.append(Paragraph(text, "attention"))
    retaken = [past for past in run.state.superseded if past.viewpoint is not None]
    redone = [past for past in run.state.superseded if past.viewpoint is None]
    if retaken or redone:
        told = f"Replaced by later ones: attempts at steps {len(redone)}, single views {len(retaken)}."
        blocks.append(Paragraph(f"{told} Their evidence was kept and is part of what was verified."))
    return Section("Deviations", tuple(blocks))


def no_deviation(run: RecordedRun) -> TableCell:
    """Return the statement on a run without deviations, which says so where the run has not been done to its end."""
    if run.state.status == "completed":
        return TableCell("No deviation: every step was done as the protocol says", "ok")
    undone = sum(step.phase != "passed" for step in run.state.steps.values())
    return TableCell(f"No deviation in what was done; {counted(undone, 'step')} not done", "attention")


def _none(run: RecordedRun) -> Paragraph:
    none = no_deviation(run)
    return Paragraph(f"{none.text}.", none.tone)


def _table(run: RecordedRun, listed: Sequence[NotableEvent]) -> Table:
    at = {event.seq: clock(event.at_utc) for event in run.events}
    columns = (
        Column("event", 0.55, "number"),
        Column("time (UTC)", 0.8),
        Column("kind", 1.0),
        Column("step", 1.5),
        Column("what happened", 3.2),
        Column("who", 0.8),
    )
    rows = tuple(
        (str(d.seq), at[d.seq], TableCell(d.kind, "attention"), d.step, d.text, run.named(d.who)) for d in listed
    )
    return Table(columns, rows)


def steps_section(run: RecordedRun) -> Section:
    """Return every step with its gates: value, limit and verdict."""
    columns = (
        Column("gate", 3.4),
        Column("value", 1.4, "number"),
        Column("limit", 1.4, "number"),
        Column("verdict", 1.1),
    )
    rows: list[tuple[TableCell | str, ...]] = []
    heads: set[int] = set()
    shots = {one.step: one for one in shots_by_step(run.protocol, run.state, failed_exposures(run.events))}
    for number, step in enumerate(run.protocol.steps, 1):
        state = run.state.steps[step.id]
        heads.add(len(rows))
        rows.append((_state(run, f"{number}. {step.title}", state, shots), "", "", ""))
        accepted = state.accepted is not None
        rows += [(*measured(v), limit(v), judged(v, accepted=accepted)) for v in state.verdicts]
    table = Table(columns, tuple(rows), frozenset(heads), frozenset(heads))
    bounded = any(v.lower is not None for state in run.state.steps.values() for v in state.verdicts)
    return Section("Steps and gates", (table, *([Paragraph(f"{BOUNDS_HOLD}.")] if bounded else [])))


def _state(run: RecordedRun, title: str, state: StepState, shots: Mapping[str, Shots]) -> TableCell:
    went_on = state.phase == "passed" and not state.skipped
    phase = ("gates overridden" if state.verdicts else "skipped") if state.skipped else words(state.phase)
    parts = [
        phase,
        "accepted outside its limits" if state.accepted else "",
        f"attempt {state.attempt}" if state.attempt > 1 else "",
    ]
    if state.started_utc:
        parts.append(f"started {clock(state.started_utc)}")
    if state.started_utc and state.ended_utc:
        parts.append(f"took {duration(state.started_utc, state.ended_utc)}")
    parts.append(shots[state.step].words if state.step in shots else "")
    parts.append(f"signed by {run.named(state.signed_by)}" if state.signed_by else "")
    within = went_on and state.accepted is None
    return TableCell(f"{title}: {', '.join(filter(None, parts))}", "plain" if within else "attention")


def people_section(run: RecordedRun) -> Section:
    """Return signatures with name, time, meaning and the hash that they bind; then who did what, and how often."""
    signatures = _signatures(run)
    unsigned = [
        step.title
        for step in run.protocol.steps
        if step.sign and not run.state.steps[step.id].signed and not run.state.steps[step.id].skipped
    ]
    blocks: list[Block] = [signatures if signatures.rows else Paragraph("Nothing was signed.", "attention")]
    if unsigned:
        blocks.append(
            Paragraph(f"Without a signature that the protocol asks for: {', '.join(unsigned)}.", "attention")
        )
    people = _people(run)
    blocks.append(people if people.rows else Paragraph("Nobody acted on this run."))
    return Section("People and signatures", tuple(blocks))


def _signatures(run: RecordedRun) -> Table:
    titles = {step.id: step.title for step in run.protocol.steps}
    rows: list[tuple[TableCell | str, ...]] = []
    for event in run.events:
        payload = event.payload
        if isinstance(payload, OperatorAction) and payload.action in ("sign", "accept"):
            meaning = f"{titles.get(payload.step or '', '')}: {_meaning(payload)}"
        elif isinstance(payload, RunReleased):
            meaning = f"Release of the run: {payload.meaning}"
        else:
            continue
        rows.append((str(event.seq), utc(event.at_utc), run.named(event.actor), meaning, payload.signed_sha256))
    columns = (
        Column("event", 0.5, "number"),
        Column("time", 1.35),
        Column("name", 0.9),
        Column("what was signed, and its meaning", 2.4),
        Column("SHA-256 of the record that was signed", 2.3, "code"),
    )
    return Table(columns, tuple(rows), small=True)


def _meaning(signed: OperatorAction) -> str:
    """Return the recorded meaning of a signature or an acceptance, and how the person was identified."""
    how = "automatic" if signed.automatic else signed.via
    how += {"pin": ", by PIN", "badge": ", by badge"}.get(signed.identified, "")
    said = f"accepted outside its limits, {signed.reason}" if signed.action == "accept" else signed.meaning
    return f"{said or 'no meaning given'} ({how})"


def _people(run: RecordedRun) -> Table:
    acts: dict[str, Counter[str]] = defaultdict(Counter)
    for event in run.events:
        if isinstance(event.payload, OperatorAction):
            acts[event.actor][event.payload.action] += 1
    rows = tuple(
        (run.named(name), ", ".join(f"{count} × {words(action)}" for action, count in sorted(counts.items())))
        for name, counts in sorted(acts.items())
    )
    return Table((Column("name", 1.0), Column("took part by", 4.0)), rows)
