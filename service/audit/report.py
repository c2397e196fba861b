"""The content of a report, made from a run's evidence: facts of its first page, course, and all other parts."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from service.audit.overview import Shots, failed_exposures, shots_by_step, together
from service.audit.recorded_run import RecordedRun, not_in_yet
from service.audit.report_accuracy import (
    accuracy_section,
    budget_section,
    further_cameras_section,
    later_section,
    result_sentence,
)
from service.audit.report_blocks import (
    Block,
    Column,
    DescriptionList,
    Paragraph,
    Report,
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
from service.audit.report_certificates import certificate_sections
from service.audit.report_origin import devices_section, software_section, verification_section
from service.audit.report_pictures import about_facts, notes_section, pictures_section
from service.core.errors import OrthocaptureError
from service.core.gates import BOUNDS_HOLD, describe_judged
from service.core.records.import_list import imported_sentence
from service.core.records.run_events import (
    DeviceTrouble,
    GatesEvaluated,
    LeaveLapsed,
    OperatorAction,
    RecordCorrected,
    RobotSeen,
    RunReleased,
    SessionStarted,
    StepFailed,
    ViewpointFailed,
)
from service.core.run.state import StepState
from service.core.words import counted
from service.dataset.registrations import late_results
from service.rig import parse_recorded_rig
from service.store.verification.verify import AuditReport

# --- the course of the run: deviations from the protocol, steps and gates, who did and signed what ----------------


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


# --- the whole report ---------------------------------------------------------------------------------------------


def facts(run: RecordedRun) -> DescriptionList:
    """Return names and values for the first page."""
    root, state, events = run.root, run.state, run.events
    shots = shots_by_step(run.protocol, state, failed_exposures(events))
    others = sorted(run.named(person) for person in state.people - {root.operator})
    status = {"active": "not finished"}.get(state.status, state.status)
    return DescriptionList(
        (
            *_of_what_and_where(run),
            ("Run", run.run_id),
            ("Started", utc(events[0].at_utc)),
            ("Last record", f"{utc(events[-1].at_utc)}, after {duration(events[0].at_utc, events[-1].at_utc)}"),
            (
                "State",
                TableCell(
                    status + (f": {state.stop_reason}" if state.stop_reason else ""),
                    "ok" if status == "completed" else "attention",
                ),
            ),
            ("Started by", run.named(root.operator)),
            ("Others who took part", ", ".join(others) or "none"),
            ("Released by", run.named(state.released_by) if state.released_by else "nobody"),
            ("Protocol", f"{root.protocol_id}, version {root.protocol_version}"),
            ("SHA-256 of the protocol", root.protocol_sha256),
            (
                "SHA-256 of the list of imported files"
                if root.origin == "imported"
                else "SHA-256 of the rig's description",
                root.rig.sha256,
            ),
            *_later(run),
            ("Photographs", together(shots).words),
            ("Records", str(len(events))),
            ("Chain head", events[-1].sha256),
        )
    )


def _of_what_and_where(run: RecordedRun) -> Iterator[tuple[str, TableCell | str]]:
    """Yield the specimen, site and purpose as entered, the rig, and the machine that drove the run."""
    entered = about_facts(run)
    names = {name for name, _ in entered}
    if "Specimen" not in names:
        yield "Specimen", "not recorded"
    yield from entered
    if "Site" not in names:
        yield "Site", "not recorded"
    hosts = list(dict.fromkeys(e.payload.host for e in run.events if isinstance(e.payload, SessionStarted)))
    at = f", driven from the machine {', '.join(hosts)}" if hosts else ""
    name = _rig_name(run)
    yield "Rig", f"{name}{at}" if name else f"not recorded{at}"


def _rig_name(run: RecordedRun) -> str:
    """Return the name in the rig file; "" for imported photographs, or if the file is missing or altered."""
    if run.root.origin == "imported":
        return ""
    try:
        path = run.files.artefact_path(run.root.rig.sha256, verify=True)
        return parse_recorded_rig(path.read_bytes(), path).section.name
    except (OrthocaptureError, OSError):
        return ""  # the first page names the file


def _later(run: RecordedRun) -> Iterator[tuple[str, TableCell]]:
    late = late_results(run.protocol, run.state)
    if late:
        yield "Results that arrived after the evaluation", TableCell(", ".join(one.name for one in late), "attention")
    missing = not_in_yet(run.protocol, run.state, run.events)
    if missing:
        yield "Results not in yet", TableCell("; ".join(missing), "attention")


def report_content(
    run: RecordedRun,
    audit: AuditReport,
    *,
    made_at: datetime | None = None,
    true_error_mm: Mapping[str, float] | None = None,
    with_scene: bool = True,
    with_pictures: bool = True,
) -> Report:
    """Return the report of a run.

    Args:
        run: the run.
        audit: the result of the verification, which is shown on the first page.
        made_at: the time stamp of the report, default: now. The same evidence and time stamp give the same report.
        true_error_mm: the true error by source of poses, which only a simulated rig knows; it is marked as such.
        with_scene: include the scene that can be turned, which only HTML can show; its drawing is always included.
        with_pictures: False leaves out everything that shows photographs.
    """
    listed = deviations(run)
    sections = _sections(run, audit, listed, true_error_mm, with_scene=with_scene, with_pictures=with_pictures)
    return Report(
        title=run.protocol.title,
        simulated=run.root.simulated,
        origin=_origin(run),
        verification=_verification(audit),
        result=result_sentence(run.summary()),
        deviations=TableCell(f"{counted(len(listed), 'deviation')}, listed first", "attention")
        if listed
        else no_deviation(run),
        release=_release(run),
        facts=facts(run),
        sections=tuple(section for section in sections if section is not None),
        run_id=run.run_id,
        head_sha256=run.events[-1].sha256,
        made_at=(made_at or datetime.now(UTC)).astimezone(UTC).replace(microsecond=0),
    )


def _sections(
    run: RecordedRun,
    audit: AuditReport,
    listed: Sequence[NotableEvent],
    true_error_mm: Mapping[str, float] | None,
    *,
    with_scene: bool,
    with_pictures: bool,
) -> list[Section | None]:
    """Return the sections in the order of the report; None stands for a section that this run does not have."""
    omitted = Paragraph("They were left out, because this report belongs to a bundle without files.")
    summary = run.summary()
    return [
        deviations_section(run, listed),
        accuracy_section(summary, true_error_mm),
        later_section(summary),
        budget_section(summary),
        further_cameras_section(run),
        steps_section(run),
        people_section(run),
        notes_section(run, with_pictures=with_pictures),
        *certificate_sections(run),
        devices_section(run),
        pictures_section(run, turning=with_scene) if with_pictures else Section("Pictures", (omitted,)),
        verification_section(run, audit),
        software_section(run),
    ]


def _verification(audit: AuditReport) -> TableCell:
    if audit.ok and not audit.verified:
        return TableCell(
            "The evidence is not verified as a whole: nothing differs, but its anchors could not be read", "attention"
        )
    if audit.first_fault is None:
        return TableCell("The evidence verifies: every file and every record is as it was recorded", "ok")
    others = len(audit.faults) - 1
    more = f", and {others} more {'fault' if others == 1 else 'faults'}" if others else ""
    return TableCell(
        f"THE EVIDENCE DOES NOT VERIFY: {audit.first_fault}{more}. Nothing in this report can be relied on.", "stop"
    )


def _origin(run: RecordedRun) -> TableCell | None:
    """Return the statement on imported photographs; None if the run took its photographs itself."""
    if run.root.origin != "imported":
        return None
    return TableCell(imported_sentence(run.events[0].at_utc, run.named(run.root.operator)), "attention")


def _release(run: RecordedRun) -> TableCell | None:
    """Return the statement on the release; None if the protocol does not ask for one."""
    if run.protocol.release != "second_person":
        return None
    if run.state.released_by:
        return TableCell(f"Released by a second person: {run.named(run.state.released_by)}", "ok")
    return TableCell("NOT RELEASED: the protocol asks that a second person reads and releases this run", "stop")
