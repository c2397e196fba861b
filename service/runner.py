"""The imperative loop: decide → act → append. The only place that executes decisions and touches hardware."""

from __future__ import annotations

import dataclasses
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import distributions
from os import getpid
from pathlib import Path
from typing import Any, NamedTuple
from typing import Protocol as Interface

from drivers.errors import DeviceError
from drivers.interfaces import DeviceReport
from service.core.equipment.clocks import clock_readings
from service.core.equipment.disk_space import Forecast, Verdict
from service.core.errors import OrthocaptureError, StoreError
from service.core.gates.verdict import describe_judged
from service.core.protocol.models import Protocol
from service.core.records.events import (
    ActionRefused,
    DeviceOpened,
    DeviceTrouble,
    OperatorAction,
    Payload,
    RunAborted,
    RunCompleted,
    SessionStarted,
    StepFailed,
    StepMeasured,
    StepNote,
    StepPassed,
    StepRetried,
    StepStarted,
)
from service.core.recovery.policy import recovery_policy
from service.core.run.actions import refuse
from service.core.run.decide import (
    AbortRun,
    Accept,
    AskOperator,
    EvaluateGates,
    FinishRun,
    Halt,
    Retry,
    RunStep,
    decide,
    evaluate_gates,
)
from service.core.run.state import RunState
from service.logs.where import at
from service.monitor.host_clock import host_clock
from service.monitor.snapshot import Doing
from service.run_record import RunFollower, StepEvidence
from service.steps import step_kinds
from service.steps.context import Devices, LeaveToMove, StepContext, StepInterruptedError, StepOutcome
from service.store.files.space_used import forecast_of, require_space
from service.store.queue.leases import RunLease
from service.store.signatures.log_copy import keep_elsewhere
from service.store.signatures.timestamps import Authority, stamp_end
from service.store.store import Store

_LEASE_S = 30.0
_POLL_S = 0.1
_PEDAL_RETRY_S = 30.0
_WRITE_NOTHING = ("checklist", "timed_application")  # step kinds that go on when the disk is full
_FORECAST_EVERY_S = 30.0
_SPACE_EVERY_S = 2.0  # in which a camera fills no more than the room that is kept
# Where the robot will move, one press arms the pedal and a second one within this time confirms: what holding the
# button is on a screen.
_PEDAL_SECOND_PRESS_S = (0.5, 6.0)


class Spoken(NamedTuple):
    """An answer by somebody else than the person who runs the run: a supervisor at the same terminal."""

    action: OperatorAction
    actor: str


class Operator(Interface):
    """The person in front of the run, or what stands in for one on a simulated rig."""

    name: str

    def poll(self, question: AskOperator, state: RunState) -> OperatorAction | Spoken | None:
        """An answer if there is one by now; called about ten times a second while a question is open."""
        ...

    def show(self, what: str, done: int, total: int) -> None:
        """Progress of the work under way."""
        ...

    def tell(self, message: str) -> None:
        """One line on what happened."""
        ...

    def busy(self, what: str) -> None:
        """Said before a call that takes its time, in words: what screens show until the next `attend`."""
        ...

    def attend(self, doing: Doing, state: RunState, *, pedal_armed: bool, asked: AskOperator | None = None) -> None:
        """Called several times a second, whatever the runner does: for what screens show."""
        ...

    def ticked(self, question: AskOperator, state: RunState) -> tuple[str, ...]:
        """The checklist items that count as done when the foot pedal confirms."""
        ...

    def prepare(self, step: str, attempt: int) -> None:
        """The work of a step is about to begin: a simulated technician does now what was confirmed as done."""
        ...

    def mend(self, step: str, attempt: int, hands: Sequence[Mapping[str, Any]]) -> None:
        """A confirmed retry is about to begin: a simulated technician first does what the step has asked for."""
        ...


@dataclass
class Runner:
    """Drives one run to its end, or to the next halt."""

    store: Store
    run_id: str
    protocol: Protocol
    devices: Devices
    operator: Operator
    authority: Authority | None = None  # asked for a time stamp when the run ends
    signature_copy: Path | None = None  # second place of the log of signatures
    monotonic_s: Callable[[], float] = time.monotonic
    wait: Callable[[float], None] = time.sleep
    _log: RunFollower = field(init=False)
    _lease: RunLease = field(init=False)
    _asked: AskOperator | None = field(init=False, default=None)
    _pedal: int | None = field(init=False, default=None)  # presses when the open question was first asked
    _pedal_again_s: float = field(init=False, default=0.0)
    _clocks_told: set[str] = field(init=False, default_factory=set[str])
    _space_due_s: float = field(init=False, default=0.0)
    _forecast_due_s: float = field(init=False, default=0.0)
    _stop_below_bytes: int = field(init=False, default=0)
    _space_told: Verdict = field(init=False, default="enough")
    _armed_s: float | None = field(init=False, default=None)  # time of the press that armed the pedal

    def run(self) -> RunState:
        """Take the lease, record the session, and act on decisions until the run ends or an operator stops it.

        A paused run waits here for its resumption. Raises LeaseHeldError if another runner drives the run.
        """
        with self.store.lease(self.run_id, f"runner on {socket.gethostname()}", _LEASE_S) as lease:
            self._lease = lease
            self._log = RunFollower(self.store, self.run_id, self.protocol)
            if self._log.state.terminal:
                if self.authority is None or not self.store.timestamps(self.run_id):
                    self._seal()  # the process died before it could, or the authority did not answer
                return self._log.state
            resumed = self._log.state.sessions > 0
            if resumed:
                self._seal()  # what the runner before could not sign any more
            self._append(
                SessionStarted(
                    resumed=resumed,
                    software=software_versions(),
                    host=socket.gethostname(),
                    pid=getpid(),
                    host_clock=host_clock(),
                )
            )
            self.devices.watch(self._opened, lambda name: self.operator.busy(f"connecting the {name}"))
            self._follow_space()
            try:
                while True:
                    state = self._log.refresh()
                    if state.terminal:
                        return state
                    self._act(state)
            finally:
                self._seal()

    def _act(self, state: RunState) -> None:
        decision = decide(self.protocol, state)
        match decision:
            case AskOperator():
                self._ask(decision, state)
            case RunStep(step, attempt, begin):
                if begin:
                    self.operator.prepare(step, attempt)
                    self._append(StepStarted(step=step, attempt=attempt))
                self._execute(step, attempt)
            case EvaluateGates(step, attempt, measures, uncertainties):
                verdicts = evaluate_gates(self.protocol.step(step), attempt, measures, state.skipped, uncertainties)
                self._append(verdicts)
                for verdict in verdicts.verdicts:
                    if not verdict.passed:
                        outside = "" if verdict.undecided else ": outside its limits"
                        self.operator.tell(f"{step}: {describe_judged(verdict)}{outside}")
            case Accept(step, attempt):
                self._append(StepPassed(step=step, attempt=attempt))
                self._seal()
                self.operator.tell(f"{self.protocol.step(step).title}: passed")
            case Retry():
                self._retry(decision, state)
            case FinishRun(deviations):
                self._append(RunCompleted(deviations=deviations))
            case AbortRun(reason):
                self._append(RunAborted(reason=reason))
            case Halt():
                self.operator.show("paused", 0, 0)
                self.operator.attend("paused", state, pedal_armed=False)
                self.wait(_POLL_S)

    def _retry(self, decision: Retry, state: RunState) -> None:
        """Begin again after the wait, unless a pause or an abort is what is to be done by then."""
        left_s = decision.wait_s
        while left_s > 0:
            self.wait(min(_POLL_S, left_s))
            left_s -= _POLL_S
            now = self._log.refresh()
            if decide(self.protocol, now) != decision:
                return
            self.operator.attend("working", now, pedal_armed=False)
        if state.step.retry_granted:
            self.operator.mend(decision.step, decision.attempt, state.step.mend.get("hands", ()))
        self._append(StepRetried(step=decision.step, attempt=decision.attempt, why=decision.why))

    # --- operator ---

    def _ask(self, question: AskOperator, state: RunState) -> None:
        answer = self._pedal_press(question, state) or self.operator.poll(question, state)
        self.operator.attend("asking", state, pedal_armed=self._armed_s is not None, asked=question)
        if answer is None:
            self.wait(_POLL_S)
            return
        if isinstance(answer, Spoken):
            self.submit(answer.action, answer.actor)
        else:
            self.submit(answer, self.operator.name)

    def submit(self, action: OperatorAction, actor: str) -> None:
        """Append an action if it is allowed now; otherwise append its refusal and say why."""
        state = self._log.refresh()
        refusal = refuse(self.protocol, state, action, actor)
        if refusal is None:
            self._append(action, actor=actor)
            return
        self._append(ActionRefused(action=action.action, step=action.step, why=str(refusal)), actor=actor)
        self.operator.tell(f"refused: {refusal}")

    def _pedal_press(self, question: AskOperator, state: RunState) -> OperatorAction | None:
        """A press of the foot pedal since the question was asked confirms it, hands-free; motion needs two."""
        if question != self._asked:
            self._asked, self._pedal, self._armed_s = question, None, None
        if not self._pressed() or "confirm" not in question.options:
            return None
        earliest_s, latest_s = _PEDAL_SECOND_PRESS_S
        if self.protocol.step(question.step).moves_robot:
            since_s = None if self._armed_s is None else self.monotonic_s() - self._armed_s
            if since_s is None or since_s < earliest_s:  # a bounce, or a foot that slipped, arms anew
                self._armed_s = self.monotonic_s()
                self.operator.tell(f"pedal: press again within {latest_s:.0f} s to let the robot move")
                return None
            self._armed_s = None
        checklist = self.operator.ticked(question, state)
        return OperatorAction(action="confirm", step=question.step, checklist=checklist, via="pedal")

    def _pressed(self) -> bool:
        """Whether the pedal was pressed since the last look; the first look at a question only counts."""
        if self._armed_s is not None and self.monotonic_s() - self._armed_s > _PEDAL_SECOND_PRESS_S[1]:
            self._armed_s = None
        if self.monotonic_s() < self._pedal_again_s:
            return False
        try:
            lightbox = self.devices.lightbox()
            presses = lightbox.pedal_presses() if lightbox is not None else 0
        except DeviceError as error:
            self._pedal_again_s = self.monotonic_s() + _PEDAL_RETRY_S
            self.operator.tell(f"the foot pedal does not work: {error}")
            return False
        if self._pedal is None or presses < self._pedal:  # a box that was switched off counts from zero
            self._pedal = presses
        pressed, self._pedal = presses != self._pedal, presses
        return pressed

    def _opened(self, device: str, report: DeviceReport) -> None:
        self._append(DeviceOpened(device=device, report=dataclasses.asdict(report)))
        self._log.refresh()
        self._look_at_clocks()

    def _look_at_clocks(self) -> None:
        """A clock beyond its limit is told once a session."""
        for reading in clock_readings(self._log.now().events):
            if reading.within is False and reading.device not in self._clocks_told:
                self._clocks_told.add(reading.device)
                self.operator.tell(reading.words)

    # --- steps ---

    def _execute(self, step_id: str, attempt: int) -> None:
        step = self.protocol.step(step_id)
        at(step=step_id, viewpoint="")
        kind = step_kinds()[step.kind]
        checkpoint = partial(self._checkpoint, step_id, attempt)
        space = self._require_space
        evidence = StepEvidence(
            self._log, self._lease, step_id, attempt, checkpoint, self.operator.show, self.wait, space
        )
        context = StepContext(
            protocol=self.protocol,
            step=step,
            attempt=attempt,
            run=self._log.state,
            devices=self.devices,
            evidence=evidence,
            checkpoint=checkpoint,
            progress=self.operator.show,
            monotonic_s=self.monotonic_s,
            wait=self.wait,
            operator=self.operator.name,
            tell=self.operator.tell,
            busy=self.operator.busy,
        )
        if (leave := self._log.state.leave) is not None:
            self.devices.let_move(LeaveToMove(leave.seq, leave.by, self._log.leave_not_before_s))
        try:
            checkpoint()
            if step.kind not in _WRITE_NOTHING:
                space()
            outcome = kind.execute(context, step.params)
        except StepInterruptedError as interruption:
            self.operator.tell(str(interruption))
        except OrthocaptureError as error:
            self._failed(step_id, attempt, error)
        else:
            self._measured(step_id, attempt, outcome)

    def _measured(self, step: str, attempt: int, outcome: StepOutcome) -> None:
        self._look_at_clocks()
        self._append(
            StepMeasured(
                step=step,
                attempt=attempt,
                measures={name: float(value) for name, value in outcome.measures.items()},
                artefacts=outcome.artefacts,
                result=dict(outcome.result),
                uncertainties=dict(outcome.uncertainties),
            )
        )

    def _failed(self, step_id: str, attempt: int, error: OrthocaptureError) -> None:
        state = self._log.refresh().steps[step_id]
        name = type(error).__name__
        policy = recovery_policy(self.protocol.step(step_id).recovery, name, state.failures + 1)
        payloads: list[Payload] = []
        if isinstance(error, DeviceError):
            payloads.append(DeviceTrouble(device=error.where or step_id, error=name, message=str(error)))
        payloads.append(StepFailed(step=step_id, attempt=attempt, error=name, message=str(error), recovery=policy))
        self._append(*payloads)
        kept = self._log.state.origin
        self.operator.tell(f"{step_id}: {error}. What was {kept} is safe")

    def _checkpoint(self, step: str, attempt: int) -> None:
        """Called by steps wherever they may stop: notices what operators have asked for."""
        state = self._log.refresh()
        self.operator.attend("pausing" if state.paused else "working", state, pedal_armed=False)
        if state.paused:
            raise StepInterruptedError("paused")
        if state.terminal or (state.current, state.step.attempt, state.phase) != (step, attempt, "running"):
            raise StepInterruptedError(f"the operator has ended this attempt; the run is {state.status}")

    def _require_space(self) -> None:
        """Follows the disk; raises SpaceShortError when it is time to stop."""
        now_s = self.monotonic_s()
        if now_s < self._space_due_s:
            return
        plenty = self.store.free_bytes() > 2 * self._stop_below_bytes
        if now_s >= self._forecast_due_s or not plenty:  # of a large run it takes a tenth of a second
            found = self._follow_space()
            require_space(self.store, found)
            self._stop_below_bytes = found.stop_below_bytes
            self._forecast_due_s = now_s + _FORECAST_EVERY_S
        self._space_due_s = now_s + _SPACE_EVERY_S

    def _follow_space(self) -> Forecast:
        """The forecast; told and recorded whenever it turns worse."""
        state = self._log.refresh()
        found = forecast_of(self.store, self.protocol, state)
        worse = found.verdict not in ("enough", self._space_told)
        self._space_told = found.verdict
        if worse:
            data = dataclasses.asdict(found) | {"verdict": found.verdict}
            self._append(StepNote(step=state.current, attempt=state.step.attempt, note="disk_space", data=data))
            if found.verdict == "short":
                self.operator.tell(f"{found.words}. The run stops and asks before the disk is full")
        return found

    def _append(self, *payloads: Payload, actor: str = "runner") -> None:
        self.store.record(self.run_id, payloads, actor=actor, lease=self._lease)

    def _seal(self) -> None:
        """Sign the chain as it stands. A seal that fails is told; the next one covers what it would have.

        The end of a run is stamped as well, where an authority is configured: the run has ended already by then.
        """
        self.operator.busy("signing the record")
        try:
            stamp_end(self.store, self.run_id, self.authority if self._log.state.terminal else None)
        except StoreError as error:
            resume = f"`orthocapture resume {self.run_id}` signs it"
            self.operator.tell(f"the record could not be signed: {error}. Once that is put right, {resume}")
        folder, files = self.store.database_path.parent, self.store.files
        keep_elsewhere(folder, self.signature_copy, self.operator.tell, files)


def software_versions() -> dict[str, str]:
    """Every installed distribution and its version, for the record."""
    found: dict[str, Any] = {d.metadata["Name"]: d.version for d in distributions()}
    return {name: str(version) for name, version in sorted(found.items()) if name}
