"""The toy run at certain steps, and what the rules refuse there."""

from __future__ import annotations

import re

from service.core.records.events import Payload
from service.core.records.run_events import OperatorAction, StepFailed
from service.core.run.actions import refuse
from tests.support.record.core import GOOD, Log


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


def assert_refused(log: Log, match: str, action: OperatorAction, actor: str) -> None:
    """The rules give a reason that matches; the log is not touched."""
    refusal = refuse(log.protocol, log.state, action, actor)
    assert refusal is not None
    assert re.search(match, str(refusal)), refusal


def refused(log: Log, match: str, **action: object) -> None:
    """The rules refuse the action; if it is in the log anyway, its only effect is a listed deviation."""
    value = OperatorAction.model_validate(action)
    assert_refused(log, match, value, "Ada")
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
