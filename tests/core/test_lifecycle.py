"""The lifecycle: the transitions that the generated machine has, and no others."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest

from service.core.documents import lifecycle_text
from service.core.errors import IllegalTransitionError
from service.core.run.lifecycle import (
    ABORTED,
    COMPLETED,
    PHASES,
    STEP_RULES,
    lifecycle,
    redo,
    state_machine,
    state_name,
    transition_table,
)
from tests.support.record.core import toy_protocol

STEPS = ("capture", "spray_on", "scan")
MACHINE = lifecycle(STEPS)


def walk(state: str, *triggers: str) -> str:
    for trigger in triggers:
        state = MACHINE.next(state, trigger)
    return state


def test_a_run_without_trouble() -> None:
    state = MACHINE.initial
    for _ in STEPS:
        state = walk(state, "begin", "measured", "gates_passed", "accept", "advance")
    assert state == COMPLETED
    assert MACHINE.triggers(COMPLETED) == ()


def test_failures_lead_through_recovering() -> None:
    assert walk("capture.running", "failed") == "capture.recovering"
    assert walk("capture.checking", "gates_failed") == "capture.recovering"
    assert walk("capture.recovering", "retry") == "capture.running"


@pytest.mark.parametrize("phase", ["ready", "recovering", "awaiting_operator"])
def test_skip_leads_to_passed(phase: str) -> None:
    assert walk(f"scan.{phase}", "skip") == "scan.passed"


@pytest.mark.parametrize("phase", ["running", "checking", "passed"])
def test_work_under_way_or_done_cannot_be_skipped(phase: str) -> None:
    with pytest.raises(IllegalTransitionError, match="'skip' is not possible"):
        walk(f"scan.{phase}", "skip")


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("step", STEPS)
def test_pause_and_resume_return_to_where_it_was(step: str, phase: str) -> None:
    paused = walk(f"{step}.{phase}", "pause")
    assert paused == f"paused.{step}.{phase}"
    assert not MACHINE.may(paused, "pause")
    assert walk(paused, "resume") == f"{step}.{phase}"


def test_work_in_flight_still_reports_while_paused() -> None:
    assert walk("capture.running", "pause", "measured", "gates_passed", "resume") == "capture.awaiting_operator"


def test_redo_leads_back_and_never_ahead() -> None:
    assert walk("scan.awaiting_operator", redo("capture")) == "capture.ready"
    assert walk("paused.scan.running", redo("spray_on")) == "paused.spray_on.ready"
    with pytest.raises(IllegalTransitionError):
        walk("capture.passed", redo("scan"))


def test_abort_from_anywhere_but_the_end() -> None:
    for state in MACHINE.states:
        assert MACHINE.may(state, "abort") == (state not in (COMPLETED, ABORTED))
    assert walk("paused.capture.running", "abort") == ABORTED


def test_the_table_is_exactly_the_rules() -> None:
    """There are no transitions beyond the listed rules, such as defaults of the library."""
    expected: set[tuple[str, str]] = set()
    for paused in (False, True):
        for index, step in enumerate(STEPS):
            expected |= {(state_name(step, rule.source, paused=paused), rule.trigger) for rule in STEP_RULES}
            expected.add((state_name(step, "passed", paused=paused), "advance"))
            for phase in PHASES:
                here = state_name(step, phase, paused=paused)
                expected |= {(here, "resume" if paused else "pause"), (here, "abort")}
                expected |= {(here, redo(earlier)) for earlier in STEPS[: index + 1]}
    assert set(MACHINE.table) == expected
    assert set(MACHINE.table.values()) <= set(MACHINE.states)


class Model:
    """What the library's machine moves; the library adds `state` and `trigger`."""

    state: str
    trigger: Callable[[str], bool]


def test_the_table_is_what_the_machine_does() -> None:
    machine, model = state_machine(STEPS), Model()
    machine.add_model(model, initial=MACHINE.initial)
    done: dict[tuple[str, str], str] = {}
    for state in MACHINE.states:
        for trigger in machine.events:
            machine.set_state(state, model)
            if model.trigger(trigger):
                done[state, trigger] = model.state
    assert done == MACHINE.table


def test_an_illegal_transition_says_what_is_possible() -> None:
    with pytest.raises(IllegalTransitionError) as caught:
        walk("capture.ready", "accept")
    assert "capture.ready" in str(caught.value)
    assert "begin" in caught.value.remedy


def test_the_machine_is_compiled_once() -> None:
    assert lifecycle(list(STEPS)) is MACHINE


def test_the_diagram_shows_every_step_and_every_rule() -> None:
    protocol = toy_protocol()
    page = lifecycle_text(protocol)
    assert page.count("```mermaid") == 2
    for rule in STEP_RULES:
        assert f"    {rule.source} --> {rule.target}: {rule.trigger}\n" in page
    for earlier, later in pairwise(protocol.step_ids):
        assert f"        {earlier} --> {later}: advance\n" in page
    for arrow in ("run --> paused: pause", "paused --> run: resume", "run --> completed: advance"):
        assert f"    {arrow}\n" in page
    for arrow in ("run --> aborted: abort", "paused --> aborted: abort"):
        assert page.count(f"    {arrow}\n") == 1
    # Every trigger of the table is drawn or, for the redos, described in words.
    for trigger, _, _ in transition_table(protocol.step_ids):
        assert f": {trigger}\n" in page or trigger.startswith("redo_"), trigger
    assert "spray (irreversible)" in page
