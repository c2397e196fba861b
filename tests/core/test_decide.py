"""The fold of a run's events, the decision it leads to, and the allowed operator actions."""

from __future__ import annotations

import pytest

import drivers.errors as device_errors
import service.core.errors as core_errors
from service.core.errors import IllegalTransitionError, IntegrityError
from service.core.gates.verdict import describe
from service.core.protocol.models import Recovery
from service.core.records.events import (
    ActionRefused,
    DeviceTrouble,
    GatesEvaluated,
    JobEnqueued,
    JobFailed,
    JobFinished,
    OperatorAction,
    Payload,
    RunAborted,
    RunCompleted,
    StepFailed,
    StepMeasured,
    StepNote,
    StepPassed,
    StepRetried,
    StepStarted,
    Uncertainty,
    ViewpointFailed,
)
from service.core.recovery.policy import NEEDS_A_PERSON, PASSING, recovery_policy
from service.core.run.decide import (
    AbortRun,
    Accept,
    AskOperator,
    EvaluateGates,
    FinishRun,
    Halt,
    Retry,
    RunStep,
    allowed_actions,
    check_action,
    decide,
    evaluate_gates,
    fold,
    initial_state,
    redoable_steps,
)
from tests.support.record.core import GOOD, TOY, Log, captured, imported, toy_protocol
from tests.support.record.counting import calls_of


@pytest.fixture
def log() -> Log:
    return Log()


def at_capture() -> Log:
    log = Log()
    log.do()
    return log


def at_spray() -> Log:
    log = at_capture()
    log.do(**GOOD)
    return log


def at_scan() -> Log:
    log = at_spray()
    log.do()
    return log


def refused(log: Log, match: str, **action: object) -> None:
    """The rules refuse the action; if it is in the log anyway, its only effect is a listed deviation."""
    value = OperatorAction.model_validate(action)
    with pytest.raises(IllegalTransitionError, match=match):
        check_action(log.protocol, log.state, value, "Ada")
    before, count = log.state, len(log.state.deviations)
    after = log.append(value, "Ada")
    assert after.deviations[-1].kind == "refused"
    assert len(after.deviations) == count + 1
    assert (after.machine_state, after.steps, after.status) == (before.machine_state, before.steps, before.status)


def failure(log: Log, error: str = "DeviceTimeoutError", recovery: str = "retry") -> Payload:
    now = log.state.step
    return StepFailed.model_validate(
        {"step": now.step, "attempt": now.attempt, "error": error, "message": "no answer", "recovery": recovery}
    )


def kinds(log: Log) -> list[str]:
    """The kinds of the deviations, without refused actions."""
    return [d.kind for d in log.state.deviations if d.kind != "refused"]


# --- a run without trouble ---------------------------------------------------------------------------------


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


def test_the_fold_is_the_reduction_by_advance() -> None:
    log = at_scan()
    assert fold(log.protocol, log.events) == log.state
    assert fold(log.protocol, log.events[:7]) != log.state


def test_automatic_confirmations_are_notes_and_only_for_simulated_rigs() -> None:
    log = Log()
    items = ["wires hold", "board lies"]
    log.act("confirm", checklist=items, automatic=True, via="auto")
    assert log.state.step.confirmed
    assert log.state.deviations[0].is_note
    assert log.state.deviation_count == 0
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


# --- gates ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("measures", "passed"),
    [
        ({"views": 3.0, "sharp": 0.2}, True),
        ({"views": 3.0, "sharp": 1.0}, True),
        ({"views": 2.999, "sharp": 0.5}, False),
        ({"views": 3.0, "sharp": 1.001}, False),
        ({"views": 3.0}, False),
        ({"views": 3.0, "sharp": float("nan")}, False),
        ({"views": float("inf"), "sharp": 0.5}, False),
    ],
)
def test_gates(measures: dict[str, float], passed: bool) -> None:
    step = toy_protocol().step("capture")
    result = evaluate_gates(step, 1, measures)
    assert result.passed is passed
    assert [v.measure for v in result.verdicts] == ["views", "sharp"]


@pytest.mark.parametrize(
    ("lower", "upper", "outcome"),
    [(3.0, 4.0, "passed"), (2.0, 2.9, "failed"), (2.9, 4.0, "undecided")],
)
def test_a_number_with_its_uncertainty_is_judged_by_its_bounds(lower: float, upper: float, outcome: str) -> None:
    step = toy_protocol().step("capture")
    known = {"views": Uncertainty(sigma=0.2, lower=lower, upper=upper)}
    result = evaluate_gates(step, 1, {"views": 3.2, "sharp": 0.5}, uncertainties=known)
    verdict = result.verdicts[0]
    found = "passed" if verdict.passed else "undecided" if verdict.undecided else "failed"
    assert (found, result.passed) == (outcome, outcome == "passed")
    assert (verdict.lower, verdict.upper, verdict.sigma) == (lower, upper, 0.2)
    places = 2 if outcome == "failed" else 1
    assert f"views {3.2:.{places}f} views, {lower:.{places}f} to {upper:.{places}f}, allowed" in describe(verdict)
    without = evaluate_gates(step, 1, {"views": 3.2, "sharp": 0.5}).verdicts[0]
    assert without.passed
    assert without.lower is None
    assert " to " not in describe(without)


def test_a_gate_falls_away_with_the_step_that_would_have_made_it_measurable() -> None:
    step = toy_protocol().step("capture")
    gates = tuple(g.model_copy(update={"unless_skipped": "ct"}) if g.measure == "sharp" else g for g in step.gates)
    step = step.model_copy(update={"gates": gates})
    assert not evaluate_gates(step, 1, {"views": 3.0}).passed
    without = evaluate_gates(step, 1, {"views": 3.0}, skipped={"ct"})
    assert without.passed
    assert [v.measure for v in without.verdicts] == ["views"]


def test_failed_gates_ask_and_can_be_overridden_only_with_leave_and_reason() -> None:
    log = at_capture()
    log.begin()
    log.measure(views=2.0, sharp=0.5)
    assert log.question.for_ == "recovery"
    assert "views 2 views, allowed ≥ 3" in log.question.text
    assert set(log.question.options) == {"confirm", "redo", "skip", "pause", "abort"}
    refused(log, "needs a reason", action="skip")
    log.act("skip", reason="the animal moved")
    assert log.state.deviations[-1].kind == "gate_overridden"
    assert log.state.steps["capture"].skipped
    assert log.state.current == "spray"


def test_verdicts_that_do_not_follow_from_the_measures_are_no_evidence() -> None:
    log = at_capture()
    log.begin()
    log.append(StepMeasured(step="capture", attempt=1, measures={"views": 1.0, "sharp": 0.5}))
    honest = evaluate_gates(log.protocol.step("capture"), 1, {"views": 1.0, "sharp": 0.5})
    with pytest.raises(IntegrityError, match="do not follow"):
        log.append(honest.model_copy(update={"passed": True}))


# --- recovery ------------------------------------------------------------------------------------------------


def test_a_retry_keeps_what_was_captured_and_raises_the_attempt() -> None:
    log = at_capture()
    log.begin()
    log.capture(["a", "b"])
    log.append(failure(log))
    assert log.decision == Retry("capture", 2, "DeviceTimeoutError: no answer", 1.0)
    log.append(StepRetried(step="capture", attempt=2, why="timeout"))
    assert log.decision == RunStep("capture", 2, begin=False)
    assert set(log.state.step.captured) == {"a", "b"}
    assert log.state.step.failures == 1
    log.capture(["c"])
    assert log.state.step.failures == 0  # progress in between
    assert log.state.deviations == ()


def test_an_operator_grants_a_retry_and_what_was_given_up_gets_another_chance() -> None:
    log = at_capture()
    log.begin()
    log.append(ViewpointFailed(step="capture", attempt=1, viewpoint="b", error="E", message="m", skipped=True))
    log.append(failure(log, "SafetyStopError", "ask"))
    assert log.question.for_ == "recovery"
    with pytest.raises(IntegrityError, match="neither the policy nor the operator"):
        log.append(StepRetried(step="capture", attempt=2, why="by itself"))
    log.act("confirm")
    assert log.decision == Retry("capture", 2, "the operator asked for it", 0.0)
    refused(log, "already confirmed", action="confirm")
    log.append(StepRetried(step="capture", attempt=2, why="asked"))
    assert log.state.step.skipped_viewpoints == ()
    assert log.state.step.failures == 0


def test_recovery_can_abort_the_run(log: Log) -> None:
    log.begin()
    log.append(failure(log, "IntegrityError", "abort"))
    assert log.decision == AbortRun("IntegrityError: no answer")
    log.append(RunAborted(reason="evidence"))
    assert log.decision == Halt("aborted")
    assert log.state.stop_reason == "evidence"


@pytest.mark.parametrize(
    ("error", "failures", "on_failure", "expected"),
    [
        ("DeviceUnavailableError", 1, "ask", "retry"),
        ("DeviceTimeoutError", 2, "abort", "retry"),
        ("DeviceTimeoutError", 3, "ask", "ask"),
        ("DeviceBusyError", 1, "ask", "ask"),
        ("DeviceBusyError", 3, "abort", "abort"),
        ("SafetyStopError", 1, "abort", "ask"),
        ("DeviceStorageFullError", 1, "abort", "ask"),
        ("IntegrityError", 1, "abort", "ask"),
        ("ComputeError", 1, "ask", "ask"),
        ("ComputeError", 1, "abort", "abort"),
    ],
)
def test_the_recovery_policy(error: str, failures: int, on_failure: str, expected: str) -> None:
    recovery = Recovery.model_validate({"retries": 2, "on_failure": on_failure})
    assert recovery_policy(recovery, error, failures) == expected


def test_the_policy_names_errors_that_exist() -> None:
    for name in PASSING | NEEDS_A_PERSON:
        assert hasattr(device_errors, name) or hasattr(core_errors, name)


# --- operator actions ----------------------------------------------------------------------------------------


def test_confirm_needs_every_item_ticked(log: Log) -> None:
    refused(log, "1 of 2 checklist items are not ticked: board lies", action="confirm", checklist=["wires hold"])
    refused(log, "not the current one", action="confirm", step="scan")
    refused(log, "no step 'nowhere'", action="confirm", step="nowhere")
    log.confirm()
    assert log.state.step.ticked == ("wires hold", "board lies")
    refused(log, "already confirmed", action="confirm", checklist=["wires hold", "board lies"])


def test_signatures_need_name_meaning_and_the_record() -> None:
    log = at_capture()
    refused(log, "no signature is due while the step is ready", action="sign", meaning="ok", signed_sha256="0" * 64)
    log.begin()
    log.measure(**GOOD)
    target = log.question.sign_sha256
    refused(log, "a record other than", action="sign", meaning="ok", signed_sha256="0" * 64)
    refused(log, "a name and a meaning", action="sign", meaning=" ", signed_sha256=target)
    refused(log, "pedal cannot sign", action="sign", meaning="ok", signed_sha256=target, via="pedal")
    with pytest.raises(IllegalTransitionError, match="a name"):
        check_action(log.protocol, log.state, OperatorAction(action="sign", meaning="m", signed_sha256=target), " ")
    with pytest.raises(IntegrityError, match="nobody has signed"):
        log.append(StepPassed(step="capture", attempt=1))
    log.act("sign", actor="Grace", meaning="captured well", signed_sha256=target)
    assert log.state.step.signed_by == "Grace"
    assert log.decision == Accept("capture", 1)


def test_skip_only_where_the_protocol_allows_it_and_only_between_works() -> None:
    log = at_spray()
    refused(log, "does not allow", action="skip", reason="no spray left")
    log = at_scan()
    log.begin()
    refused(log, "cannot be skipped while it is running", action="skip", reason="slow")


def test_pause_holds_everything_but_work_in_flight() -> None:
    log = at_capture()
    log.begin()
    log.act("pause")
    assert log.decision == Halt("paused")
    assert log.state.paused
    refused(log, "paused already", action="pause")
    for action in ("confirm", "sign", "skip"):
        refused(log, "Resume first", action=action, reason="r")
    log.capture(["a"])  # the shutter had been released
    assert log.decision == Halt("paused")
    log.act("resume")
    assert log.decision == RunStep("capture", 1, begin=False)
    assert set(log.state.step.captured) == {"a"}
    refused(log, "not paused", action="resume")


def test_abort_ends_the_run_and_late_records_are_kept_without_effect() -> None:
    log = at_capture()
    log.begin()
    log.act("abort", reason="fire alarm")
    log.capture(["a"])
    log.append(failure(log))
    log.append(RunAborted(reason="operator"))
    assert log.decision == Halt("aborted")
    assert log.state.stop_reason == "fire alarm"
    assert log.state.steps["capture"].captured == {}
    assert log.state.overtaken == (log.state.seq - 2, log.state.seq - 1)


def test_refusals_by_the_command_line_are_deviations(log: Log) -> None:
    log.append(ActionRefused(action="skip", step="spray", why="not allowed"))
    assert log.state.deviations[0].text == "skip refused: not allowed"
    assert log.state.deviation_count == 1


# --- redo ------------------------------------------------------------------------------------------------------


def test_redo_supersedes_the_step_and_resets_the_later_ones() -> None:
    log = at_capture()
    log.begin()
    log.capture(["a"])
    refused(log, "needs a reason", action="redo", step="fix_it")
    refused(log, "has not begun", action="redo", step="scan", reason="x")
    log.act("redo", step="fix_it", reason="a wire was loose")
    assert log.state.current == "fix_it"
    assert log.state.steps["fix_it"].attempt == 2
    capture = log.state.steps["capture"]
    assert (capture.attempt, capture.phase, capture.captured) == (2, "pending", {})
    assert [(s.step, s.attempt) for s in log.state.superseded] == [("fix_it", 1), ("capture", 1)]
    assert kinds(log) == ["redo", "reset_by_redo"]
    assert "a" in log.state.superseded[1].captured
    # Records of the superseded work arrive late:
    log.capture([])
    log.append(captured("capture", 1, "b"))
    log.append(StepMeasured(step="capture", attempt=1, measures=GOOD))
    assert len(log.state.overtaken) == 2
    assert log.state.steps["capture"] == capture
    refused(log, "nothing to redo", action="redo", reason="again")
    log.do()
    assert log.state.current == "capture"
    assert log.question.for_ == "confirm"


def test_redo_of_one_viewpoint_while_running_and_after() -> None:
    log = at_capture()
    log.begin()
    log.capture(["a", "b"])
    refused(log, "has not been captured", action="redo", viewpoint="z", reason="r")
    log.act("redo", viewpoint="a", reason="glare")
    assert log.state.phase == "running"
    assert set(log.state.step.captured) == {"b"}
    log.capture(["a", "c"])
    log.measure(**GOOD)
    log.act("redo", viewpoint="b", reason="hand in view")
    assert (log.state.phase, log.state.step.attempt) == ("ready", 2)
    assert set(log.state.step.captured) == {"a", "c"}
    assert log.question.for_ == "confirm"  # before the arm moves again
    log.begin()
    log.capture(["b"])
    log.measure(**GOOD)
    log.accept()
    assert kinds(log) == ["redo_viewpoint", "redo_viewpoint"]
    refused(log, "in the current step only", action="redo", step="capture", viewpoint="a", reason="late")


def test_imported_photographs_count_as_views_and_the_run_says_so() -> None:
    log = at_capture()
    log.begin()
    log.append(imported("capture", log.state.step.attempt, "a"))
    log.append(imported("capture", log.state.step.attempt, "a"))
    assert set(log.state.step.captured) == {"a"}
    assert log.state.superseded[-1].reason == "imported again"
    assert log.state.origin == "captured"  # as stated at the root of the chain, also for older runs without the field


def test_a_redo_races_with_the_last_record(log: Log) -> None:
    log = at_scan()
    log.do(rms_mm=0.01)
    log.do()
    log.act("redo", reason="just seen it")
    log.append(RunCompleted(deviations=0))
    assert log.state.status == "active"
    assert log.decision == RunStep("register", 2, begin=True)
    with pytest.raises(IntegrityError, match="run_completed"):
        log.append(RunCompleted(deviations=0))


# --- irreversible steps ----------------------------------------------------------------------------------------


def test_an_irreversible_step_needs_passed_captures_a_signature_and_a_confirmation() -> None:
    log = at_spray()
    refused(log, "released by a signature", action="confirm", checklist=["window open"])
    with pytest.raises(IntegrityError, match="not confirmed"):
        log.append(StepStarted(step="spray", attempt=1))
    log.sign()
    with pytest.raises(IntegrityError, match="not confirmed"):
        log.append(StepStarted(step="spray", attempt=1))
    log.confirm()
    assert log.decision == RunStep("spray", 1, begin=True)


def test_a_skipped_capture_does_not_release_it() -> None:
    log = at_capture()
    log.act("skip", reason="camera broken")
    assert log.question.for_ == "recovery"
    assert "capture" in log.question.text
    assert "confirm" not in log.question.options
    assert "redo" in log.question.options
    assert redoable_steps(log.protocol, log.state) == ("fix_it", "capture")
    refused(log, "not passed: capture", action="confirm", checklist=["window open"])
    refused(log, "not passed: capture", action="sign", meaning="go", signed_sha256="")
    log.act("redo", step="capture", reason="camera mended")
    log.do(**GOOD)
    assert log.question.for_ == "sign"


def test_nothing_before_it_can_be_redone_once_it_has_begun() -> None:
    log = at_spray()
    assert redoable_steps(log.protocol, log.state) == ("fix_it", "capture")
    log.begin()
    refused(log, "'spray' has changed the scene", action="redo", step="capture", reason="blurred")
    log.append(failure(log, "SafetyStopError", "ask"))  # half of it counts
    log.act("redo", reason="can was empty")
    assert log.question.for_ == "sign"  # released again
    refused(log, "has changed the scene", action="redo", step="capture", reason="blurred")
    log.do()
    log.do(rms_mm=0.01)
    refused(log, "has changed the scene", action="redo", step="fix_it", reason="x")
    assert redoable_steps(log.protocol, log.state) == ("spray", "scan")
    log.act("redo", step="scan", reason="holes")
    assert log.state.current == "scan"


def test_a_retried_irreversible_step_keeps_its_release() -> None:
    log = at_spray()
    log.begin()
    log.append(failure(log))
    log.append(StepRetried(step="spray", attempt=2, why="timeout"))
    log.measure()
    assert log.decision == Accept("spray", 2)
    log.accept()
    assert log.state.current == "scan"


def test_a_step_that_requires_another_without_being_irreversible() -> None:
    text = TOY.replace(
        "    confirm: false\n    gates: [{measure: rms", "    requires: [fix_it]\n    gates: [{measure: rms"
    )
    log = Log(toy_protocol(text))
    log.act("skip", reason="in a hurry")
    log.do(**GOOD)
    log.do()
    refused(log, "not passed: fix_it", action="confirm")
    assert allowed_actions(log.protocol, log.state) == ("redo", "skip", "pause", "abort")


# --- jobs --------------------------------------------------------------------------------------------------------


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


# --- evidence that cannot be ------------------------------------------------------------------------------------


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


def test_questions_are_values() -> None:
    log = Log()
    assert isinstance(log.decision, AskOperator)
    assert log.decision == decide(log.protocol, fold(log.protocol, log.events))
