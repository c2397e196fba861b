"""The fold of a run's events, and the decision it leads to."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import pytest

from service.core.errors import IntegrityError
from service.core.records.events import Payload, SiteOpened
from service.core.records.run_events import (
    DeviceTrouble,
    GatesEvaluated,
    JobEnqueued,
    JobFailed,
    JobFinished,
    RunCompleted,
    StepMeasured,
    StepNote,
    StepPassed,
    StepRetried,
    StepStarted,
    ViewpointFailed,
)
from service.core.run.decide import (
    Accept,
    AskOperator,
    EvaluateGates,
    FinishRun,
    Halt,
    RunStep,
    decide,
    fold,
    initial_state,
)
from service.core.run.effects import is_void
from service.core.run.fold import DECISIVE_EVENTS, RUN_EVENTS, advance, kind_of
from service.core.run.state import Status
from tests.support.record.core import GOOD, TOY, Log, captured, toy_protocol
from tests.support.record.core_log import at_capture, at_scan, failure, refused
from tests.support.record.counting import calls_of


@pytest.fixture
def log() -> Log:
    return Log()


# --- a run without trouble -------------------------------------------------------------------------------


def test_nothing_is_decided_before_run_started() -> None:
    protocol = toy_protocol()
    with pytest.raises(IntegrityError, match="nothing is recorded"):
        decide(protocol, initial_state(protocol))


def test_the_decisions_of_a_run_in_order(log: Log) -> None:
    assert log.question.for_ == "confirm"
    assert log.question.checklist == ("wires hold", "board lies")
    log.confirm()
    assert log.decision == RunStep("fix_it", 1, begin=True)
    log.append(StepStarted(step="fix_it", attempt=1))
    assert log.decision == RunStep("fix_it", 1, begin=False)
    log.append(StepMeasured(step="fix_it", attempt=1, measures={"n": 2.0}))
    assert log.decision == EvaluateGates("fix_it", 1, {"n": 2.0})
    log.append(GatesEvaluated(step="fix_it", attempt=1, verdicts=(), passed=True))
    assert log.decision == Accept("fix_it", 1)
    log.append(StepPassed(step="fix_it", attempt=1))

    log.begin()
    log.capture(["a", "b", "c"])
    assert dict(log.state.step.captured) == {"a": log.state.seq - 2, "b": log.state.seq - 1, "c": log.state.seq}
    log.measure(**GOOD)
    assert log.question.for_ == "sign"
    assert log.question.sign_sha256 == log.events[-1].sha256
    log.accept()

    assert log.question.for_ == "sign"  # an irreversible step is released before it is confirmed
    assert log.question.sign_sha256 == log.events[-1].sha256
    log.sign()
    assert log.question.for_ == "confirm"
    log.begin()
    log.measure()
    assert log.decision == Accept("spray", 1)
    log.accept()

    assert log.decision == RunStep("scan", 1, begin=True)  # needs no confirmation
    log.do(rms_mm=0.05)
    log.do()
    assert log.decision == FinishRun(0)
    log.append(RunCompleted(deviations=0))
    assert log.decision == Halt("completed")
    assert log.state.terminal
    assert [s.phase for s in log.state.steps.values()] == ["passed"] * 5
    assert log.state.step.ended_utc > log.state.step.started_utc
    refused(log, "the run is completed", action="redo", reason="x")


def test_a_release_binds_the_required_step_that_passed_last() -> None:
    """Signing the earlier one would leave open what was done after it."""
    log = Log(toy_protocol(TOY.replace("requires: [capture]", "requires: [fix_it, capture]")))
    log.do()
    of_the_first = log.events[-1].sha256
    log.do(**GOOD)
    assert log.question.for_ == "sign"
    assert log.question.sign_sha256 == log.events[-1].sha256 != of_the_first
    log = Log(toy_protocol(TOY.replace("requires: [capture]", "requires: [capture, fix_it]")))
    log.do()
    log.do(**GOOD)
    assert log.question.sign_sha256 == log.events[-1].sha256


def test_the_fold_is_the_reduction_by_advance() -> None:
    log = at_scan()
    assert fold(log.protocol, log.events) == log.state
    assert fold(log.protocol, log.events[:7]) != log.state


def test_automatic_confirmations_are_notes_and_only_for_simulated_rigs() -> None:
    log = Log()
    items = ["wires hold", "board lies"]
    log.act("confirm", checklist=items, automatic=True, via="auto")
    assert log.state.step.confirmed
    assert [d.kind for d in log.state.automatic] == ["automatic"]
    assert log.state.deviations == ()
    for log in (Log(simulated=False), Log(auto_confirm=False)):
        refused(log, "simulated rigs only", action="confirm", checklist=items, automatic=True)


def test_progress_survives_in_the_state() -> None:
    log = at_capture()
    log.begin()
    log.append(StepNote(step="capture", attempt=1, note="station entered", data={"station": "s"}))
    log.append(ViewpointFailed(step="capture", attempt=1, viewpoint="b", error="E", message="blurred"))
    log.append(ViewpointFailed(step="capture", attempt=1, viewpoint="b", error="E", message="blurred", skipped=True))
    log.append(DeviceTrouble(device="camera", error="E", message="gone"))
    now = log.state.step
    assert now.viewpoint_failures == {"b": 2}
    assert now.skipped_viewpoints == ("b",)
    assert now.notes[0].data == {"station": "s"}
    assert log.state.troubles[0].device == "camera"
    assert [d.kind for d in log.state.deviations] == ["viewpoint_skipped"]
    log.capture(["b"])
    assert log.state.step.skipped_viewpoints == ()
    log.capture(["b"])  # retaken: the later one counts, the earlier one stays listed
    assert log.state.step.captured == {"b": log.state.seq}
    assert log.state.superseded[-1].captured == {"b": log.state.seq - 1}


# --- jobs ------------------------------------------------------------------------------------------------


def job(log: Log, name: str, attempt: int = 1) -> JobEnqueued:
    step = log.state.current
    return JobEnqueued(
        job=name, job_kind="detect", step=step, attempt=attempt, idempotency_key=name, arguments={"n": 1}
    )


def finished(step: str, name: str, attempt: int = 1) -> JobFinished:
    return JobFinished(
        job=name, job_kind="detect", step=step, attempt=attempt, worker="w", measures={"rms": 0.1}, duration_s=1.0
    )


def test_jobs_are_followed_through_retries_and_end_with_a_redo() -> None:
    log = at_capture()
    log.begin()
    log.append(job(log, "one"))
    log.append(job(log, "two"))
    log.append(finished("capture", "one"))
    log.append(
        JobFailed(job="two", job_kind="detect", step="capture", attempt=1, worker="w", error="E", message="dark")
    )
    jobs = log.state.step.jobs
    assert (jobs["one"].status, jobs["one"].measures) == ("finished", {"rms": 0.1})
    assert (jobs["two"].status, jobs["two"].message) == ("failed", "dark")
    log.append(finished("capture", "one"))  # a second worker after a lost lease
    assert len(log.state.overtaken) == 1
    with pytest.raises(IntegrityError, match="never enqueued"):
        log.append(finished("capture", "three"))
    log.append(failure(log))
    log.append(StepRetried(step="capture", attempt=2, why="r"))
    assert set(log.state.step.jobs) == {"one", "two"}
    log.act("redo", reason="dark")
    assert log.state.step.jobs == {}
    log.append(finished("capture", "two"))
    assert len(log.state.overtaken) == 2


# --- evidence that cannot be -----------------------------------------------------------------------------


def impossible() -> list[tuple[str, Payload]]:
    return [
        ("passed before it ran", StepPassed(step="capture", attempt=1)),
        ("a later step", StepStarted(step="scan", attempt=1)),
        ("an attempt ahead", StepStarted(step="capture", attempt=2)),
        ("an unknown step", StepStarted(step="nowhere", attempt=1)),
        ("captured while not running", captured("capture", 1, "a")),
        ("measured while not running", StepMeasured(step="capture", attempt=1, measures={})),
        ("completed in the middle", RunCompleted(deviations=0)),
        ("retried without failure", StepRetried(step="capture", attempt=2, why="")),
        ("a step that has passed", StepMeasured(step="fix_it", attempt=1, measures={})),
    ]


@pytest.mark.parametrize(("name", "payload"), impossible(), ids=[name for name, _ in impossible()])
def test_impossible_events_are_an_integrity_error(name: str, payload: Payload) -> None:
    log = at_capture()
    with pytest.raises(IntegrityError, match="cannot have happened here") as caught:
        log.append(payload)
    assert f"event {len(log.events) + 1}" in caught.value.where


def test_events_must_be_complete_and_of_one_run() -> None:
    log = at_capture()
    with pytest.raises(IntegrityError, match="missing or repeated"):
        fold(log.protocol, [*log.events[:3], *log.events[4:]])
    with pytest.raises(IntegrityError, match="begins with run_started"):
        log.append(log.events[0].payload)
    with pytest.raises(IntegrityError, match="another run"):
        fold(log.protocol, [log.events[0], log.events[1].model_copy(update={"run_id": "other"})])
    with pytest.raises(IntegrityError, match="not of the given one"):
        fold(toy_protocol(TOY.replace("id: toy", "id: other")), log.events)


def test_folding_a_thousand_events_is_quick() -> None:
    log = at_capture()
    log.begin()
    for index in range(1000):
        log.append(captured("capture", 1, f"v{index}"))
    assert len(fold(log.protocol, log.events).step.captured) == 1000
    # 96 calls per event when this was written, whatever their number.
    assert calls_of(lambda: fold(log.protocol, log.events)) < 200 * len(log.events)


@pytest.mark.parametrize(
    ("attempt", "status", "skipped", "when_completed", "void"),
    [
        (2, "active", False, False, False),
        (1, "active", False, False, True),  # of an attempt before a redo
        (2, "active", True, False, True),
        (1, "active", True, False, True),
        (2, "paused", False, False, False),
        (2, "aborted", False, False, True),
        (2, "completed", False, False, True),
        (2, "completed", False, True, False),  # what may still be recorded then
        (2, "aborted", False, True, True),
        (2, "completed", True, True, True),
    ],
)
def test_work_is_void_after_a_redo_a_skip_or_the_end(
    attempt: int, status: Status, skipped: bool, when_completed: bool, void: bool
) -> None:
    log = at_capture()
    step = replace(log.state.steps["capture"], attempt=2, skipped=skipped)
    state = replace(log.state, status=status, steps={**log.state.steps, "capture": step})
    event = log.events[-1]
    assert is_void(state, event, "capture", attempt, when_completed=when_completed) is void
    if not void:
        with pytest.raises(IntegrityError, match="attempt 3 of capture has not begun"):
            is_void(state, event, "capture", 3, when_completed=when_completed)
        with pytest.raises(IntegrityError, match="no step 'other'"):
            is_void(state, event, "other", attempt, when_completed=when_completed)


def test_a_step_whose_gates_were_overridden_does_not_count_as_skipped() -> None:
    """Its figures exist, so later gates that need them are judged; those of a step without figures fall away."""
    early, late = at_capture(), at_capture()
    early.act("skip", reason="no animal")
    late.begin()
    late.measure(views=2.0, sharp=0.5)
    late.act("skip", reason="the animal moved")
    assert early.state.steps["capture"].skipped
    assert late.state.steps["capture"].skipped
    assert (early.state.skipped, late.state.skipped) == ({"capture"}, set())


def test_questions_are_values() -> None:
    log = Log()
    assert isinstance(log.decision, AskOperator)
    assert log.decision == decide(log.protocol, fold(log.protocol, log.events))


def test_every_kind_of_event_is_folded_unless_it_belongs_to_the_sites_chain() -> None:
    """So neither the state of a run nor the auditor's digest of it misses a kind that is added later."""
    recorded = get_args(get_args(Payload)[0]) or get_args(Payload)
    left = {payload.__module__ for payload in recorded if kind_of(payload) not in RUN_EVENTS}
    assert left == {SiteOpened.__module__}


def test_the_decisive_events_alone_lead_to_the_same_end_and_deviations() -> None:
    log = at_capture()
    log.begin()
    log.append(StepNote(step="capture", attempt=1, note="planned", data={}))
    log.append(failure(log))
    log.append(StepRetried(step="capture", attempt=2, why="the policy"))
    log.capture(["a", "b", "c"])
    log.measure(**GOOD)
    log.act("confirm", step="scan")  # refused
    log.accept()
    log.do()
    log.do(rms_mm=0.05)
    log.do()
    log.append(RunCompleted(deviations=len(log.state.deviations)))
    decisive = [event for event in log.events if event.payload.kind in DECISIVE_EVENTS]
    assert {event.payload.kind for event in log.events} - set(DECISIVE_EVENTS) == {"step_note"}
    state = initial_state(log.protocol)
    for event in decisive:
        state = advance(log.protocol, replace(state, seq=event.seq - 1), event)
    assert state.status == "completed"
    assert (state.machine_state, state.deviations) == (log.state.machine_state, log.state.deviations)
    assert state.deviations
