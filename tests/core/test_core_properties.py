"""Random runs through the core: whatever operators, devices and restarts do, the rules hold."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from service.core.errors import IntegrityError
from service.core.records.events import Payload
from service.core.records.run_events import (
    OperatorAction,
    RunCompleted,
    StepFailed,
    StepMeasured,
    StepPassed,
    StepRetried,
    StepStarted,
    ViewpointFailed,
)
from service.core.recovery import recovery_policy
from service.core.run.actions import refuse
from service.core.run.decide import (
    Accept,
    AskOperator,
    EvaluateGates,
    FinishRun,
    Halt,
    Retry,
    RunState,
    RunStep,
    StepState,
    allowed_actions,
    evaluate_gates,
    fold,
    record_to_sign,
    redoable_steps,
)
from service.core.run.lifecycle import lifecycle
from tests.support.record.core import Log, captured, toy_protocol

PROTOCOL = toy_protocol()
STEPS = PROTOCOL.step_ids
MACHINE = lifecycle(STEPS)
STATES = frozenset(MACHINE.states)
VIEWPOINTS = ("a", "b", "c")

ACTIONS = st.fixed_dictionaries(
    {
        "action": st.sampled_from(["confirm", "sign", "redo", "skip", "pause", "resume", "resume"]),
        "step": st.sampled_from([None, None, None, *STEPS]),
        "viewpoint": st.sampled_from([None, None, "a", "z"]),
        "reason": st.sampled_from(["", "because"]),
        "tick": st.sampled_from(["all", "all", "some"]),
        "meaning": st.sampled_from(["checked", "checked", ""]),
        "right_hash": st.sampled_from([True, True, False]),
        "automatic": st.booleans(),
    }
)
ERRORS = st.sampled_from(
    ["DeviceTimeoutError", "DeviceBusyError", "SafetyStopError", "ComputeError", "IntegrityError"]
)
# (sharp, rms_mm): the first passes every gate
FIGURES = st.sampled_from([(0.5, 0.05), (0.5, 0.05), (0.5, 0.05), (0.0, 0.5), (3.0, 0.05), (float("nan"), 0.05)])


class Runs(RuleBasedStateMachine):
    """A runner that obeys decisions, an operator who does anything at any time, and restarts."""

    def __init__(self) -> None:
        super().__init__()
        self.log = Log(PROTOCOL)
        self.attempts = dict.fromkeys(STEPS, 1)
        self.frozen: dict[str, StepState] = {}

    # --- what may happen ---

    @rule(fields=ACTIONS)
    def operator(self, fields: dict[str, Any]) -> None:
        state = self.log.state
        items = PROTOCOL.step(state.current).checklist
        action = OperatorAction(
            action=fields["action"],
            step=fields["step"],
            viewpoint=fields["viewpoint"] if fields["action"] == "redo" else None,
            reason=fields["reason"],
            checklist=items if fields["tick"] == "all" else items[:-1],
            meaning=fields["meaning"],
            signed_sha256=record_to_sign(PROTOCOL, state) if fields["right_hash"] else "f" * 64,
            automatic=fields["automatic"],
        )
        refusal = refuse(PROTOCOL, state, action, "Ada")
        after = self.log.append(action, "Ada")
        if refusal is not None:
            assert (after.machine_state, after.steps) == (state.machine_state, state.steps)
            assert after.deviations[-1].kind == "refused"
        else:
            assert (
                not after.deviations or after.deviations[-1].kind != "refused" or after.deviations == state.deviations
            )

    @initialize(decisions=st.integers(min_value=0, max_value=30))
    def start_anywhere(self, decisions: int) -> None:
        """Make every depth of the protocol equally likely."""
        self._progress(decisions, (0.5, 0.05), 3.0)

    @rule(decisions=st.integers(min_value=1, max_value=14), figure=FIGURES, views=st.sampled_from([2.0, 3.0, 3.0]))
    def steady_progress(self, decisions: int, figure: tuple[float, float], views: float) -> None:
        """Progress without obstacles for a while; the figures may be bad."""
        self._progress(decisions, figure, views)

    def _progress(self, decisions: int, figure: tuple[float, float], views: float) -> None:
        for _ in range(decisions):
            if isinstance(self.log.decision, AskOperator):
                self._answer(self.log.question)
            else:
                missing = next((v for v in VIEWPOINTS if v not in self.log.state.step.captured), "")
                capture = self.log.state.current == "capture" and bool(missing)
                outcome = "capture" if capture else "measure"
                self._one_decision(missing, outcome, "ComputeError", figure, views)

    def _answer(self, question: AskOperator) -> None:
        """Do what is asked."""
        if question.for_ == "sign":
            self.log.sign()
        elif "confirm" in question.options:
            self.log.confirm()
        elif "redo" in question.options:
            self.log.act("redo", step="capture", reason="it was skipped")

    @rule(
        viewpoint=st.sampled_from(VIEWPOINTS),
        outcome=st.sampled_from(["capture", "capture", "lose", "give up", "fail", "measure", "measure"]),
        error=ERRORS,
        figure=FIGURES,
        views=st.sampled_from([2.0, 3.0, 3.0]),
    )
    def runner(self, viewpoint: str, outcome: str, error: str, figure: tuple[float, float], views: float) -> None:
        """Execute one decision, with any outcome."""
        self._one_decision(viewpoint, outcome, error, figure, views)

    def _one_decision(
        self,
        viewpoint: str,
        outcome: str,
        error: str,
        figure: tuple[float, float],
        views: float,
    ) -> None:
        """Execute a decision as the runner does."""
        decision = self.log.decision
        match decision:
            case RunStep(step, attempt, begin):
                assert self.log.state.status == "active"
                if begin:
                    self._released(step)
                    self.log.append(StepStarted(step=step, attempt=attempt))
                else:
                    self.log.append(self._work(step, attempt, viewpoint, outcome, error, figure, views))
            case EvaluateGates(step, attempt, measures):
                self.log.append(evaluate_gates(PROTOCOL.step(step), attempt, measures))
            case Accept(step, attempt):
                assert self.log.state.steps[step].gates_passed
                self.log.append(StepPassed(step=step, attempt=attempt))
            case Retry(step, attempt):
                self.log.append(StepRetried(step=step, attempt=attempt, why="again"))
            case FinishRun(deviations):
                self.log.append(RunCompleted(deviations=deviations))
            case AskOperator() | Halt():
                pass

    def _work(
        self,
        step: str,
        attempt: int,
        viewpoint: str,
        outcome: str,
        error: str,
        figure: tuple[float, float],
        views: float,
    ) -> Payload:
        match outcome:
            case "capture":
                return captured(step, attempt, viewpoint)
            case "lose" | "give up":
                return ViewpointFailed(
                    step=step,
                    attempt=attempt,
                    viewpoint=viewpoint,
                    error=error,
                    message="m",
                    skipped=outcome == "give up",
                )
            case "fail":
                policy = recovery_policy(PROTOCOL.step(step).recovery, error, self.log.state.step.failures + 1)
                return StepFailed(step=step, attempt=attempt, error=error, message="m", recovery=policy)
            case _:
                measures = {"views": views, "sharp": figure[0], "rms_mm": figure[1]}
                return StepMeasured(step=step, attempt=attempt, measures=measures)

    def _released(self, step: str) -> None:
        """What must be true before any work begins, checked without the core's own helpers."""
        now = self.log.state.steps[step]
        if PROTOCOL.step(step).confirm:
            assert now.confirmed
            assert set(now.ticked) >= set(PROTOCOL.step(step).checklist)
        if step == "spray":
            capture = self.log.state.steps["capture"]
            assert now.signed
            assert capture.phase == "passed"
            assert not capture.skipped
            assert all(verdict.passed for verdict in capture.verdicts)
            assert {verdict.measure for verdict in capture.verdicts} == {"views", "sharp"}

    @rule()
    def legal_skip(self) -> None:
        """A skip that is offered must be accepted."""
        state = self.log.state
        if not state.terminal and "skip" in allowed_actions(PROTOCOL, state):
            after = self.log.act("skip", reason="no time")
            assert after.steps[state.current].skipped
            assert after.deviations[-1].kind in ("skip", "gate_overridden")

    @rule(pick=st.integers(min_value=0, max_value=9), viewpoint=st.booleans())
    def legal_redo(self, pick: int, viewpoint: bool) -> None:
        """Every redo that is offered must be accepted, whatever is in progress."""
        state = self.log.state
        captured_now = sorted(state.step.captured)
        if viewpoint and captured_now and not state.terminal:
            after = self.log.act("redo", viewpoint=captured_now[pick % len(captured_now)], reason="glare")
            assert after.deviations[-1].kind in ("redo_viewpoint", "refused")  # the scene may have changed since
            return
        offered = redoable_steps(PROTOCOL, state)
        if offered and pick < 6:
            step = offered[pick % len(offered)]
            after = self.log.act("redo", step=step, reason="not good enough")
            assert (after.current, after.phase) == (step, "ready")
            assert after.steps[step].attempt == state.steps[step].attempt + 1
            assert after.paused == state.paused

    @rule(doubts=st.integers(min_value=0, max_value=7))
    def abort(self, doubts: int) -> None:
        """Rare, or no run would get far."""
        if doubts == 7:
            self.log.act("abort", reason="enough")

    @rule(
        meanwhile=st.sampled_from(["pause", "redo", "redo", "redo viewpoint", "abort"]),
        outcome=st.sampled_from(["capture", "lose", "fail", "measure"]),
        viewpoint=st.sampled_from(VIEWPOINTS),
        doubts=st.integers(min_value=0, max_value=3),
    )
    def race(self, meanwhile: str, outcome: str, viewpoint: str, doubts: int) -> None:
        """An operator acts while the hardware works; the work done is then recorded and never refused."""
        decision = self.log.decision
        if not isinstance(decision, RunStep) or decision.begin or (meanwhile == "abort" and doubts):
            return
        step, attempt, before = decision.step, decision.attempt, self.log.state
        done = self._work(step, attempt, viewpoint, outcome, "DeviceTimeoutError", (0.5, 0.05), 3.0)
        if meanwhile == "redo viewpoint":
            self.log.act("redo", viewpoint=viewpoint, reason="glare")
        else:
            self.log.act(meanwhile, reason="stop that")  # type: ignore[arg-type] # a verb, by the match above
        after = self.log.append(done)
        if meanwhile in ("redo", "abort") and not self._refused_just_now(after):
            assert after.overtaken[-1] == after.seq
            assert after.steps[step].captured == ({} if meanwhile == "redo" else before.step.captured)

    def _refused_just_now(self, state: RunState) -> bool:
        return any(d.kind == "refused" and d.seq == state.seq - 1 for d in state.deviations)

    @rule(change=st.sampled_from(["step", "attempt", "phase"]))
    def impossible_event(self, change: str) -> None:
        """A step_passed that is not due is never accepted."""
        state = self.log.state
        if state.terminal or (state.phase == "awaiting_operator" and change == "phase"):
            return
        step = STEPS[-1] if change == "step" else state.current
        there = state.steps[step]
        attempt = there.attempt + (change == "attempt")
        if there.skipped or (step == state.current and state.phase == "awaiting_operator" and change == "step"):
            return
        with pytest.raises(IntegrityError):
            self.log.append(StepPassed(step=step, attempt=attempt))
        assert self.log.state is state

    @rule()
    def restart(self) -> None:
        """The process dies; only the record remains."""
        self.log.state = fold(PROTOCOL, self.log.events)

    # --- what must always hold ---

    @invariant()
    def refold_equals_live(self) -> None:
        assert fold(PROTOCOL, self.log.events) == self.log.state

    @invariant()
    def the_state_is_a_state_of_the_machine(self) -> None:
        state = self.log.state
        assert state.machine_state in STATES
        place = MACHINE.place(state.machine_state)
        assert (place is None) == state.terminal
        if place is not None:
            assert (place.step, place.phase, place.paused) == (state.current, state.phase, state.paused)
        for index, step in enumerate(STEPS):
            if index < STEPS.index(state.current):
                assert state.steps[step].phase == "passed"
            elif index > STEPS.index(state.current):
                assert state.steps[step].phase == "pending"

    @invariant()
    def no_step_passes_with_a_failed_gate(self) -> None:
        for step in STEPS:
            now = self.log.state.steps[step]
            if now.phase != "passed":
                continue
            if now.skipped:
                assert PROTOCOL.step(step).skippable
                assert any(
                    d.step == step and d.kind in ("skip", "gate_overridden") for d in self.log.state.deviations
                )
                continue
            for gate in PROTOCOL.step(step).gates:
                value = now.measures[gate.measure]
                assert gate.min is None or value >= gate.min
                assert gate.max is None or value <= gate.max
            assert now.signed or not PROTOCOL.step(step).sign

    @invariant()
    def what_was_before_an_irreversible_step_stands(self) -> None:
        """Once spraying has begun, its captures have passed, and nothing before it is ever reset."""
        if not any(isinstance(e.payload, StepStarted) and e.payload.step == "spray" for e in self.log.events):
            return
        before = {step: self.log.state.steps[step] for step in ("fix_it", "capture")}
        self.frozen = self.frozen or before
        assert before == self.frozen
        assert before["capture"].signed
        assert not before["capture"].skipped
        assert before["capture"].measures["views"] >= 3.0

    @invariant()
    def stopped_runs_do_nothing(self) -> None:
        if self.log.state.status != "active":
            assert self.log.decision == Halt(self.log.state.status)

    @invariant()
    def attempts_rise(self) -> None:
        for step in STEPS:
            attempt = self.log.state.steps[step].attempt
            assert attempt >= self.attempts[step]
            self.attempts[step] = attempt


@pytest.mark.slow
class TestRuns(Runs.TestCase):  # type: ignore[misc, name-defined] # hypothesis builds the class at run time
    settings = settings(
        max_examples=80,
        stateful_step_count=30,
        deadline=None,
        derandomize=True,
        suppress_health_check=[HealthCheck.filter_too_much],
    )


def _quick_run(choose: Callable[[AskOperator], str]) -> Log:
    log = Log(PROTOCOL)
    while not isinstance(log.decision, (FinishRun, Halt)):
        decision = log.decision
        match decision:
            case AskOperator():
                (log.sign if choose(decision) == "sign" else log.confirm)()
            case RunStep(step, attempt, begin):
                figures = {"views": 3.0, "sharp": 0.5, "rms_mm": 0.05}
                done = StepStarted(step=step, attempt=attempt)
                log.append(done if begin else StepMeasured(step=step, attempt=attempt, measures=figures))
            case EvaluateGates(step, attempt, measures):
                log.append(evaluate_gates(PROTOCOL.step(step), attempt, measures))
            case _:
                assert isinstance(decision, Accept)
                log.append(StepPassed(step=decision.step, attempt=decision.attempt))
    return log


def test_every_prefix_of_a_run_can_be_resumed() -> None:
    """The fold of any prefix gives exactly the live run's decision at that point."""
    log = _quick_run(lambda question: question.for_)
    assert log.decision == FinishRun(0)
    live = Log(PROTOCOL)
    for event in log.events[1:]:
        live.append(event.payload, event.actor)
        assert fold(PROTOCOL, log.events[: event.seq]) == live.state
