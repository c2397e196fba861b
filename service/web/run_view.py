"""What the run page shows, as plain data: a pure function of the record, the runner's last report and who looks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from service.core.disk_space import Forecast
from service.core.gates import acceptors, demanded_role, dependent_steps, depends_on, failed_gates
from service.core.protocol import Protocol, Step, irreversible_warning
from service.core.recorded_devices import clock_readings
from service.core.records.events import Event
from service.core.records.run_events import FilesKept, ItemTicked, OperatorAction, OperatorVerb, RecordedView
from service.core.recovery import WayOn, takes_words
from service.core.run.actions import needs_leave, needs_signature_now, record_to_sign, redoable_steps
from service.core.run.decide import AskOperator, lapsed_words
from service.core.run.expected import EarlierTimes, away_words, run_words, step_words, tries_words, work_words
from service.core.run.state import RunState, lost_arms
from service.core.words import time_here
from service.dataset.registrations import evaluated
from service.monitor.snapshot import STOPS, Snapshot
from service.run_record import OpenJob
from service.steps.notes import images_taken
from service.web.images import unused_count
from service.web.run_frame import (
    count,
    drawing_of,
    figure_line,
    needs,
    phase_words,
    run_standing,
    sentence,
    station_of,
    stopped_words,
    way_words,
    will_happen,
)
from service.web.run_view_records import (
    Acceptance,
    ChecklistItem,
    Choice,
    JudgedStep,
    MainAction,
    Question,
    RecordOfRun,
    RunView,
    SignedContent,
    StepLine,
    StepMore,
    StepRedo,
    StepTrouble,
    StepView,
    Viewer,
    capture_progress,
    gate_lines,
    readings,
)

if TYPE_CHECKING:
    from service.store.objects.spool import SpoolLevel

NOT_MEASURED: EarlierTimes = {}


def run_view(
    log: RecordOfRun,
    snapshot: Snapshot,
    viewer: Viewer,
    *,
    driven: bool,
    show: str = "",
    to_come: Sequence[str] = (),
    computing: Sequence[OpenJob] = (),
    space: Forecast | None = None,
    spool: SpoolLevel | None = None,
    earlier: EarlierTimes = NOT_MEASURED,
    now_utc: str = "",
) -> RunView:
    """Return the page of a run that has started.

    Args:
        log: the run's record.
        snapshot: the runner's latest report.
        viewer: the person who looks at the page.
        driven: true if a running process drives the run.
        show: step to look at; the current one if it is "" or unknown.
        to_come: texts on what is still being computed.
        computing: the jobs that wait or are computed, which a person may end.
        space: forecast of what the run will still write; None if it is not known.
        spool: how full the spool is before an object store; None for a site without one.
        earlier: the times that the steps took in earlier runs.
        now_utc: the time of the page; "" where none is to be compared with it.
    """
    protocol, state = log.protocol, log.state
    shown = show if show in state.steps else state.current
    stands = run_standing(protocol, state, driven=driven, robot=snapshot.robot)
    decision, mode = stands.decision, stands.mode
    stopped = mode == "recover"
    unused = unused_count(state, log.events, shown)
    return RunView(
        run_id=state.run_id,
        title=protocol.title,
        seq=state.seq,
        status=state.status,
        mode=mode,
        headline=stands.headline,
        tab=_tab(protocol, state, shown, mode),
        current=state.current,
        attempt=state.step.attempt,
        steps=tuple(_line(protocol, state, step, shown, stopped=stopped) for step in protocol.steps),
        passed=sum(step.phase == "passed" for step in state.steps.values()),
        shown=_shown(protocol, state, protocol.step(shown), earlier, stopped=stopped, unused=unused),
        judged=() if state.terminal else tuple(_judged(protocol, state, log.events)),
        question=_question(log, snapshot, decision, mode, may_operate=viewer.may_operate),
        viewer=viewer,
        progress=capture_progress(protocol, state, log.events),
        readings=readings(snapshot, space, clock_readings(log.events), spool),
        working=(snapshot.what, snapshot.done, snapshot.total) if snapshot.doing == "working" else ("", 0, 0),
        takes=_takes(protocol, state, earlier, now_utc),
        work_left=run_words(protocol, state, earlier, now_utc) if now_utc else "",
        tries=tries_words(protocol, state, time_here),
        deviations=tuple(reversed(state.deviations)),
        news=tuple((m.at_utc, m.text) for m in reversed(snapshot.messages)),
        to_come=tuple(to_come),
        computing=tuple(computing),
        pedal_armed=snapshot.pedal_armed,
        stop_reason=state.stop_reason,
        operator=state.operator,
        released_by=state.released_by,
    )


# By these a person has decided something at the page; a pause says nothing about what was read.
_DECIDED = frozenset({"confirm", "sign", "redo", "skip", "accept", "resume"})


def _judged(protocol: Protocol, state: RunState, events: Sequence[Event]) -> Iterator[JudgedStep]:
    """Yield the steps whose verdicts came since a person last decided something: nobody may have seen them yet."""
    acts = (event for event in reversed(events) if isinstance(event.payload, ItemTicked | OperatorAction))
    decided = (event.seq for event in acts if not isinstance(act := event.payload, OperatorAction) or _decides(act))
    since = next(decided, 0)
    for step in sorted(protocol.steps, key=lambda step: -state.steps[step.id].passed_seq):
        now = state.steps[step.id]
        if now.phase == "passed" and now.passed_seq > since and now.verdicts and not step.params.only_ticks:
            figures = tuple(figure_line(verdict) for verdict in now.verdicts)
            yield JudgedStep(step.id, step.title, now.passed_seq, figures, accepted=now.accepted is not None)


def _decides(act: OperatorAction) -> bool:
    return act.action in _DECIDED and not act.automatic


def _takes(protocol: Protocol, state: RunState, earlier: EarlierTimes, now_utc: str) -> tuple[str, ...]:
    if not now_utc:
        return ()
    words = (said(protocol, state, earlier, now_utc, time_here) for said in (work_words, away_words))
    return tuple(line for line in words if line)


def _question(log: RecordOfRun, snapshot: Snapshot, decision: object, mode: str, *, may_operate: bool) -> Question:
    protocol, state = log.protocol, log.state
    return Question(
        main=_main(protocol, state, decision, mode, stopped=snapshot.robot in STOPS),
        options=_options(decision, state),
        can_pause=mode not in ("ended", "died", "paused") and may_operate,
        asked_anew=needs_leave(protocol, state) and mode in ("ask", "more", "recover"),
        lapsed=sentence(lapsed_words(state.lapse)) if state.lapse is not None and not state.restarted else "",
        standing=snapshot.doing == "paused" and snapshot.robot == "standing" and not lost_arms(state),
        paused=_paused_words(state, snapshot),
        more=_more(state) if mode == "more" else None,
        trouble=None if mode == "more" else _trouble(log, decision),
        ways=_ways(decision, mode),
        signature=_signature(protocol, state),
        acceptance=_acceptance(protocol, state),
        redos=() if state.terminal else tuple(_redo(protocol, state, s) for s in redoable_steps(protocol, state)),
        skip_overrides=bool(state.step.verdicts) and not state.step.gates_passed,
    )


def _paused_words(state: RunState, snapshot: Snapshot) -> str:
    """Return how it stands with a paused run and its robot; what is not known to stand still is not said to."""
    if snapshot.doing != "paused" or snapshot.robot == "moving":
        return "Pausing… the robot may still move."
    if lost_arms(state):
        return "Paused. Take the robot as moving: nobody has looked since its connection was lost."
    if snapshot.robot in STOPS:
        return f"Paused. The robot reports: {snapshot.robot.replace('_', ' ')}."
    told = {"standing": "The robot stands still.", "not_connected": "The robot is not connected."}
    return f"Paused. {told.get(snapshot.robot, 'The robot does not answer: take it as moving.')}"


def _line(protocol: Protocol, state: RunState, step: Step, shown: str, *, stopped: bool) -> StepLine:
    there = state.steps[step.id]
    word, tone, icon = phase_words(state, there, stopped=stopped)
    again = any(past.step == step.id and past.viewpoint is None for past in state.superseded)
    if again and tone in ("passed", "current"):
        word = f"{word}, attempt {there.attempt}"
    return StepLine(step.id, step.title, word, tone, icon, step.id == shown, there.phase != "pending")


def _shown(
    protocol: Protocol, state: RunState, step: Step, earlier: EarlierTimes, *, stopped: bool, unused: int
) -> StepView:
    now = state.steps[step.id]
    checks = tuple(ChecklistItem(item, item in now.ticked) for item in step.checklist)
    undone = step.irreversible and now.phase != "passed"
    images = images_taken(step, now)
    return StepView(
        id=step.id,
        title=step.title,
        number=protocol.index(step.id) + 1,
        attempt=now.attempt,
        by_hand=step.by_hand,
        only_ticks=step.params.only_ticks,
        why=step.why,
        instructions="\n".join(" ".join(part.split()) for part in step.instructions.split("\n\n")),
        drawing=drawing_of(step),
        picture=next((ref.sha256 for ref in reversed(now.artefacts) if ref.kind == "layout_overlay"), ""),
        station=station_of(step),
        status=phase_words(state, now, stopped=stopped)[0],
        current=step.id == state.current and not state.terminal,
        checklist=checks,
        open_items=sum(not check.ticked for check in checks),
        gates=gate_lines(step, now, state.skipped),
        warning=irreversible_warning(protocol, step) if undone else "",
        requires=tuple((protocol.step(name).title, state.steps[name].passed_its_gates) for name in step.requires),
        captured=images.taken,
        unused=unused,
        planned=images.known,
        signed_by=now.signed_by,
        skipped=now.skipped,
        started_utc=now.started_utc,
        ended_utc=now.ended_utc,
        table=evaluated(protocol, state) if step.gives == "accuracy" and now.result else (),
        depends=depends_on(protocol, state, step.id),
        usual=step_words(protocol, state, step, earlier),
    )


def _main(protocol: Protocol, state: RunState, decision: object, mode: str, *, stopped: bool) -> MainAction | None:
    main = _wanted(protocol, state, decision, mode)
    if main is not None and main.hold and stopped:
        return replace(main, enabled=False, why_not="The robot is stopped. Clear the stop at the robot first.")
    lost = lost_arms(state)
    if main is not None and main.hold and lost:
        look = f"You say with it that you have looked at {' and '.join(lost)}, whose connection was lost."
        return replace(main, note=f"{look} {main.note}")
    return main


def _wanted(protocol: Protocol, state: RunState, decision: object, mode: str) -> MainAction | None:
    step, now = protocol.step(state.current), state.step
    moves = step.moves_robot
    if mode == "died":
        asks = " You are asked again before the robot moves." if moves else " Nothing moves."
        return MainAction("go-on", "Go on", "The run goes on where it stopped." + asks)
    if mode == "paused":
        under_way = now.phase == "running"
        note = "The robot goes on with its viewpoints." if moves and under_way else "The run goes on where it paused."
        return MainAction("resume", "Resume", note, hold=moves)
    if mode == "ask":
        text, note = will_happen(step, now)
        left = sum(item not in now.ticked for item in step.checklist)
        why_not = f"{count(left, 'item is', 'items are')} not ticked yet." if left else ""
        return MainAction("confirm", text, note, hold=moves, enabled=not left, why_not=why_not)
    if mode == "sign":
        return MainAction("sign", f"Sign: {step.title[:1].lower()}{step.title[1:]}", "Your signature is asked for.")
    return _again(protocol, state, decision) if mode in ("recover", "more") else None


def _again(protocol: Protocol, state: RunState, decision: object) -> MainAction | None:
    """Offer another attempt: what the step asks for in its normal course, or one more try after a failure."""
    moves, wanted = protocol.step(state.current).moves_robot, state.step.in_course
    if wanted is not None:
        return MainAction("confirm", wanted.does, "What was taken before is kept.", hold=moves)
    if not isinstance(decision, AskOperator) or "confirm" not in decision.options:
        return None
    note = "What was captured is kept; only what is missing is done."
    ways = [way for way in decision.ways if way.available]
    again = next((way for way in ways if way.verb == "confirm"), None)
    recommended = bool(ways) and ways[0] == again
    named = again is not None and (state.step.mend is not None or not recommended)
    text = f"Try again: {way_words(state, again)}" if named and again is not None else "Try again"
    note += " The robot moves." if moves else ""
    note = note if recommended else f"Not what is recommended. {note}"
    return MainAction("confirm", text, note, hold=moves, recommended=recommended)


def _options(decision: object, state: RunState) -> tuple[OperatorVerb, ...]:
    if state.terminal:
        return ()
    asked = decision.options if isinstance(decision, AskOperator) else ()
    others: list[OperatorVerb] = [verb for verb in asked if verb in ("accept", "skip")]
    return (*others, "redo", "abort")


def _more(state: RunState) -> StepMore | None:
    wanted = state.step.in_course
    if wanted is None:
        return None
    return StepMore(
        wanted.title, sentence(wanted.advice), tuple(needs(v) for v in state.step.verdicts if not v.passed)
    )


def _tab(protocol: Protocol, state: RunState, shown: str, mode: str) -> str:
    """Return the title of the page in the browser's tab."""
    return f"Run {state.status}" if mode == "ended" and shown == state.current else protocol.step(shown).title


def _photographs(events: Sequence[Event]) -> int:
    """Return the photographs in the record: views, those that were replaced too, and others that a camera gave."""
    views = sum(isinstance(event.payload, RecordedView) for event in events)
    kept = (event.payload for event in events if isinstance(event.payload, FilesKept))
    return views + sum(ref.kind == "layout_image" for files in kept for ref in files.artefacts)


def _trouble(log: RecordOfRun, decision: object) -> StepTrouble | None:
    protocol, state = log.protocol, log.state
    if not isinstance(decision, AskOperator) or decision.for_ != "recovery":
        return None
    step, now = protocol.step(state.current), state.step
    images = _photographs(log.events)
    recorded = f"{count(images, 'photograph is', 'photographs are')} recorded, and every result so far"
    safe = f"Yes. {recorded if images else 'Everything so far is recorded'}."
    advice = now.mend.advice if now.mend is not None else ""
    short = stopped_words(protocol, state, decision)
    if now.failure is not None:
        return StepTrouble(f"{step.title} did not work", short, sentence(now.failure.message), safe, advice)
    failed = [figure_line(verdict) for verdict in now.verdicts if not verdict.passed]
    if failed:
        undecided = all(verdict.passed or verdict.undecided for verdict in now.verdicts)
        found = "not decided yet" if undecided else "outside its limits"
        return StepTrouble(f"{step.title}: {found}", short, "; ".join(failed), safe, advice)
    return StepTrouble(f"{step.title} cannot begin yet", short, decision.text, safe, advice)


_BUTTONS: Mapping[OperatorVerb, str] = {
    "redo": "Do again…",
    "skip": "Go on without…",
    "accept": "Accept…",
    "abort": "End here…",
}


def _ways(decision: object, mode: str) -> tuple[Choice, ...]:
    """Return the choices; without what the large button does, where that is the normal course and stands above."""
    if not isinstance(decision, AskOperator):
        return ()
    return tuple(_way(way) for way in decision.ways if mode != "more" or way.verb != "confirm")


def _way(way: WayOn) -> Choice:
    takes = takes_words(way.minutes)
    return Choice(way.verb, way.step, sentence(way.words), takes, way.loses, way.why_not, _BUTTONS.get(way.verb, ""))


def _signature(protocol: Protocol, state: RunState) -> SignedContent | None:
    if state.terminal or not needs_signature_now(protocol, state):
        return None
    step = protocol.step(state.current)
    if step.irreversible:
        steps: tuple[str, ...] = step.requires
        meaning = f"I approve that this step begins, which cannot be undone: {step.title}"
    else:
        steps = (step.id,)
        meaning = f"I have checked these figures and accept them: {step.title}"
    figures = tuple(
        (protocol.step(name).title, tuple(figure_line(verdict) for verdict in state.steps[name].verdicts))
        for name in steps
        if state.steps[name].verdicts
    )
    sha256 = record_to_sign(protocol, state)
    return SignedContent(sha256, step.title, figures, meaning) if sha256 else None


def _acceptance(protocol: Protocol, state: RunState) -> Acceptance | None:
    role = "" if state.terminal else demanded_role(protocol, state)
    if not role:
        return None
    return Acceptance(
        sha256=state.step.gates_sha256,
        title=protocol.step(state.current).title,
        figures=tuple(figure_line(verdict) for verdict in failed_gates(state.step)),
        role=role,
        another="another_supervisor" in acceptors(protocol, state),
        affects=tuple(protocol.step(name).title for name in dependent_steps(protocol, state.current)),
    )


def _redo(protocol: Protocol, state: RunState, target: str) -> StepRedo:
    steps = protocol.steps[protocol.index(target) :]
    begun = [s for s in steps if state.steps[s.id].started_utc or state.steps[s.id].skipped]
    images = sum(len(state.steps[s.id].captured) for s in begun)
    return StepRedo(target, protocol.step(target).title, tuple(s.title for s in begun if s.id != target), images)
