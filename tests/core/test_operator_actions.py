"""What an operator may do at each point of a run, what is refused, and what redo and irreversible steps change."""

from __future__ import annotations

import pytest

from service.core.errors import IntegrityError
from service.core.gates import release_meaning
from service.core.records.run_events import (
    ActionRefused,
    OperatorAction,
    RunAborted,
    RunCompleted,
    StepMeasured,
    StepPassed,
    StepRetried,
    StepStarted,
)
from service.core.run.actions import refuse
from service.core.run.decide import (
    Accept,
    Halt,
    RunStep,
    allowed_actions,
    redoable_steps,
)
from tests.support.record.core import GOOD, TOY, Log, captured, imported, toy_protocol
from tests.support.record.core_log import assert_refused, at_capture, at_scan, at_spray, failure, kinds, refused


@pytest.fixture
def log() -> Log:
    return Log()


# --- operator actions ------------------------------------------------------------------------------------


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
    assert_refused(log, "a name", OperatorAction(action="sign", meaning="m", signed_sha256=target), " ")
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


def test_who_ends_a_run_says_why_and_one_that_was_once_ended_without_still_is() -> None:
    log = at_capture()
    for reason in ("", "  "):
        refusal = refuse(log.protocol, log.state, OperatorAction(action="abort", reason=reason), "Ada")
        assert refusal is not None
        assert "abort needs a reason" in str(refusal)
    log.act("abort")  # as recorded by an earlier version
    assert log.decision == Halt("aborted")
    assert log.state.stop_reason == "aborted by Ada"
    assert not log.state.deviations


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
    assert len(log.state.deviations) == 1


# --- redo ------------------------------------------------------------------------------------------------


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


# --- irreversible steps ----------------------------------------------------------------------------------


def test_an_irreversible_step_needs_passed_captures_a_signature_and_a_confirmation() -> None:
    log = at_spray()
    refused(log, "approved by a signature", action="confirm", checklist=["window open"])
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


def test_a_release_names_the_first_twenty_deviations_and_counts_the_others(log: Log) -> None:
    for _ in range(21):
        log.act("resume")
    words = release_meaning(log.state)
    assert "release it with its 21 deviations: refused, resume had no effect" in words
    assert words.count("resume had no effect") == 20
    assert words.endswith("; and 1 more")
