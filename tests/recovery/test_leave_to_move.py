"""After a restart the robot moves only after a person has confirmed again, by name, whatever was confirmed before."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from service.core.records.run_events import OperatorAction, SessionStarted, StepFailed, StepStarted
from service.core.recovery import recovery_policy
from service.core.run.decide import AskOperator, Retry, RunStep
from tests.support.record.core import TOY, Log, captured, toy_protocol
from tests.support.record.core_log import assert_refused

CHECKED = TOY.replace("    title: Capture\n", "    title: Capture\n    checklist: [nobody in reach]\n")


def restart(log: Log) -> None:
    """Another process drives the run from here on."""
    log.append(SessionStarted(resumed=True, software={}, host="h", pid=2))


def at_the_capture(text: str = TOY) -> Log:
    """A run whose first process has reached the step that moves the robot."""
    log = Log(toy_protocol(text))
    log.append(SessionStarted(resumed=False, software={}, host="h", pid=1))
    log.act("skip", step="fix_it", reason="no need")
    return log


def confirmed(text: str = TOY) -> Log:
    log = at_the_capture(text)
    log.act("confirm", step="capture", checklist=log.protocol.step("capture").checklist)
    return log


def running(text: str = TOY) -> Log:
    log = confirmed(text)
    log.append(StepStarted(step="capture", attempt=1))
    log.append(captured("capture", 1, "v1"))
    return log


def failing(text: str = TOY) -> Log:
    """A temporary failure, which is retried without asking."""
    log = running(text)
    failed = StepFailed(step="capture", attempt=1, error="DeviceTimeoutError", message="no answer", recovery="retry")
    log.append(failed)
    return log


def granted(text: str = TOY) -> Log:
    """A failure, and a person who has let the robot try again."""
    log = running(text)
    log.append(StepFailed(step="capture", attempt=1, error="BlurError", message="not sharp", recovery="ask"))
    log.act("confirm", step="capture", checklist=log.protocol.step("capture").checklist)
    return log


@pytest.mark.parametrize("begin", [confirmed, running, failing, granted])
def test_it_is_asked_again_whatever_was_confirmed_before(begin: Callable[[], Log]) -> None:
    log = begin()
    assert isinstance(log.decision, RunStep | Retry)
    restart(log)
    assert "confirm" in log.question.options
    log.act("confirm", actor="Grace", step="capture")
    assert isinstance(log.decision, RunStep | Retry)
    assert log.state.step.confirmed_by == "Grace"


def test_a_retry_that_was_granted_before_the_restart_is_granted_again_or_not_at_all() -> None:
    """The leave to move ended with the process that had it, also the leave to try again."""
    log = granted()
    assert log.decision == Retry("capture", 2, "the operator asked for it", 0.0)
    restart(log)
    assert log.question.for_ == "recovery"
    assert "BlurError: not sharp" in log.question.text
    restart(log)
    assert isinstance(log.decision, AskOperator)
    log.act("confirm", actor="Grace", step="capture")
    assert log.decision == Retry("capture", 2, "the operator asked for it", 0.0)


def test_the_words_say_what_happens_and_what_is_kept() -> None:
    log = running()
    restart(log)
    assert "ended during this step (Capture); its image is kept" in log.question.text
    assert "the robot moves as soon as you confirm" in log.question.text


def test_the_checklist_is_ticked_anew() -> None:
    log = running(CHECKED)
    restart(log)
    assert log.question.checklist == ("nobody in reach",)
    log.act("confirm", step="capture")
    assert isinstance(log.decision, AskOperator), "without the tick it is refused"
    log.act("confirm", step="capture", checklist=("nobody in reach",))
    assert log.decision == RunStep("capture", 1, begin=False)


def test_a_second_restart_asks_a_second_time() -> None:
    log = running()
    restart(log)
    log.act("confirm", step="capture")
    restart(log)
    assert isinstance(log.decision, AskOperator)


def test_who_resumes_a_paused_run_has_let_it_go_on() -> None:
    log = running()
    log.act("pause")
    restart(log)
    log.act("resume", actor="Grace")
    assert log.decision == RunStep("capture", 1, begin=False)


def test_each_confirmation_and_resumption_is_a_leave_of_its_own_and_a_restart_ends_it() -> None:
    log = confirmed()
    first = log.state.leave
    assert first is not None
    log.append(StepStarted(step="capture", attempt=1))
    log.act("pause")
    assert log.state.leave == first
    log.act("resume", actor="Grace")
    second = log.state.leave
    assert second is not None
    assert (second.by, second.seq > first.seq) == ("Grace", True)
    restart(log)
    assert log.state.leave is None


def test_an_action_that_is_refused_is_no_leave() -> None:
    log = at_the_capture(CHECKED)
    log.act("confirm", step="capture")
    assert log.state.leave is None, "the item is not ticked"


@pytest.mark.parametrize("error", ["SafetyStopError", "LeaveNeededError"])
def test_what_took_the_leave_is_never_tried_again_without_a_person(error: str) -> None:
    recovery = toy_protocol(TOY).step("capture").recovery.model_copy(update={"retries": 3, "on_failure": "abort"})
    assert recovery_policy(recovery, error, 1) == "ask"


def test_a_step_that_moves_nothing_goes_on_by_itself() -> None:
    log = Log(toy_protocol())
    log.append(SessionStarted(resumed=False, software={}, host="h", pid=1))
    log.act("confirm", step="fix_it", checklist=("wires hold", "board lies"))
    log.append(StepStarted(step="fix_it", attempt=1))
    restart(log)
    assert log.decision == RunStep("fix_it", 1, begin=False)


def test_a_run_that_was_not_restarted_needs_no_second_confirmation() -> None:
    log = running()
    assert_refused(log, "nothing to confirm", OperatorAction(action="confirm", step="capture"), "Ada")


def test_a_step_that_moves_the_robot_never_begins_by_itself() -> None:
    log = at_the_capture(TOY.replace("    title: Capture\n", "    title: Capture\n    confirm: false\n"))
    assert isinstance(log.decision, AskOperator)
    log.act("confirm", step="capture")
    assert log.decision == RunStep("capture", 1, begin=True)
