"""The imperative loop: decide → act → append. Only this package executes decisions and drives hardware."""

from __future__ import annotations

import dataclasses
import socket
from dataclasses import dataclass, field
from os import getpid

from drivers.interfaces import DeviceReport, PedalReading
from service.core.gates.verdict import describe_judged
from service.core.protocol.models import Protocol
from service.core.records.events import (
    ActionRefused,
    DeviceOpened,
    OperatorAction,
    RunAborted,
    RunCompleted,
    SessionStarted,
    StepPassed,
    StepRetried,
    StepStarted,
)
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
from service.core.run.tries import tries_words
from service.monitor.host_clock import host_clock
from service.runner.clocks import ClockWatch
from service.runner.disk import DiskWatch
from service.runner.execution import StepExecution, WorkerWatch
from service.runner.held_run import HeldRun, held_run
from service.runner.leave import LeaveWatch
from service.runner.memory import short_collections
from service.runner.operator import AnswerBy, Operator
from service.runner.pedal import Pedal
from service.runner.sealing import Seal
from service.runner.software import software_versions
from service.steps.context import Devices
from service.store.signatures.second_place import SecondPlace
from service.store.signatures.timestamps import Authority
from service.store.store import Store

_POLL_S = 0.1


@dataclass
class Runner:
    """Drives one run to its end, by the store's clock.

    `authority`, if given, stamps the record when the run ends; `second_place` gets copies of the signatures.
    """

    store: Store
    run_id: str
    protocol: Protocol
    devices: Devices
    operator: Operator
    authority: Authority | None = None
    second_place: SecondPlace | None = None
    _run: HeldRun = field(init=False)
    _seal: Seal = field(init=False)
    _pedal: Pedal = field(init=False)
    _clocks: ClockWatch = field(init=False)
    _leave: LeaveWatch = field(init=False)
    _steps: StepExecution = field(init=False)

    def run(self) -> RunState:
        """Take the lease, record the session, and execute decisions until the run ends; a paused run waits here.

        Raises LeaseHeldError if another runner drives the run, LeaseLostError if one has taken it over.
        """
        operator, clock = self.operator, self.store.clock
        with short_collections(), held_run(self.store, self.run_id, self.protocol) as self._run:
            place = self.second_place or SecondPlace([], clock)
            self._seal = Seal(self.store, self.run_id, self.authority, place, operator.busy, operator.tell)
            if self._run.state.terminal:
                self._seal.sign_if_missing()
                return self._run.state
            disk = DiskWatch(self._run, self.protocol, operator.tell, clock.monotonic_s)
            self._pedal = Pedal(self._pedal_reading, clock.monotonic_s, operator.tell)
            self._clocks = ClockWatch(self._run.follower, operator.tell)
            data = self.store.database_path.parent
            workers = WorkerWatch(data, operator.tell, clock)
            self._leave = LeaveWatch(self._run, self.protocol, data, clock, operator.tell)
            self._steps = StepExecution(
                self._run, self.protocol, self.devices, operator, disk, workers, self._leave, clock
            )
            self._begin_session()
            disk.forecast()
            try:
                while not (state := self._run.refresh()).terminal:
                    self._leave.look(state)
                    self._steps.note_connections()
                    self._act(state)
                return state
            finally:
                self._seal.sign(ended=self._run.state.terminal)

    def submit(self, action: OperatorAction, actor: str) -> None:
        """Record an action if it is allowed now; otherwise record its refusal and tell the operator why."""
        refusal = refuse(self.protocol, self._run.refresh(), action, actor)
        if refusal is None:
            self._leave.given_here()
            self._run.append(action, actor=actor)
            return
        self._run.append(ActionRefused(action=action.action, step=action.step, why=str(refusal)), actor=actor)
        self.operator.tell(f"refused: {refusal}")

    def _begin_session(self) -> None:
        resumed = self._run.state.sessions > 0
        if resumed:
            self._seal.sign(ended=False)  # sign what the last runner could not sign any more
        self._run.append(
            SessionStarted(
                resumed=resumed,
                software=software_versions(),
                host=socket.gethostname(),
                pid=getpid(),
                host_clock=host_clock(),
            )
        )
        self.devices.watch(self._opened, lambda name: self.operator.busy(f"connecting the {name}"))

    def _act(self, state: RunState) -> None:
        decision = decide(self.protocol, state)
        match decision:
            case AskOperator():
                self._ask(decision, state)
            case RunStep(step, attempt, begin):
                if begin:
                    self.operator.prepare(step, attempt)
                    self._run.append(StepStarted(step=step, attempt=attempt))
                self._steps.execute(step, attempt)
                self._clocks.look()
            case EvaluateGates():
                self._judge(decision, state)
            case Accept(step, attempt):
                self._run.append(StepPassed(step=step, attempt=attempt))
                self._seal.sign(ended=False)
                self.operator.tell(f"{self.protocol.step(step).title}: passed")
            case Retry():
                self._retry(decision, state)
            case FinishRun(deviations):
                self._run.append(RunCompleted(deviations=deviations))
            case AbortRun(reason):
                self._run.append(RunAborted(reason=reason))
            case Halt():
                self.operator.show("paused", 0, 0)
                self.operator.attend("paused", state, pedal_armed=False)
                self.store.clock.sleep(_POLL_S)

    def _judge(self, due: EvaluateGates, state: RunState) -> None:
        step = self.protocol.step(due.step)
        verdicts = evaluate_gates(step, due.attempt, due.measures, state.skipped, due.uncertainties)
        self._run.append(verdicts)
        for verdict in verdicts.verdicts:
            if not verdict.passed:
                outside = "" if verdict.undecided else ": outside its limits"
                self.operator.tell(f"{due.step}: {describe_judged(verdict)}{outside}")

    def _retry(self, decision: Retry, state: RunState) -> None:
        """Begin again after the wait, unless the decision has changed by then, such as by a pause or an abort."""
        left_s = decision.wait_s
        if not state.step.retry_granted:
            self.operator.tell(tries_words(self.protocol, state) or decision.why)
        while left_s > 0:
            self.store.clock.sleep(min(_POLL_S, left_s))
            left_s -= _POLL_S
            now = self._run.refresh()
            if decide(self.protocol, now) != decision or self._leave.lapsed(now):
                return
            self._steps.note_connections()
            self.operator.attend("working", now, pedal_armed=False)
        if not state.step.retry_granted and self._leave.lapsed(self._run.refresh()):
            return
        if state.step.retry_granted:
            hands = () if state.step.mend is None else state.step.mend.hands
            self.operator.mend(decision.step, decision.attempt, hands)
        self._run.append(StepRetried(step=decision.step, attempt=decision.attempt, why=decision.why))

    def _ask(self, question: AskOperator, state: RunState) -> None:
        answer = self._by_pedal(question, state) or self.operator.poll(question, state)
        self.operator.attend("asking", state, pedal_armed=self._pedal.armed, asked=question)
        if answer is None:
            self.store.clock.sleep(_POLL_S)
        elif isinstance(answer, AnswerBy):
            self.submit(answer.action, answer.actor)
        else:
            self.submit(answer, self.operator.name)

    def _by_pedal(self, question: AskOperator, state: RunState) -> OperatorAction | None:
        if not self._pedal.confirms(question, moves_robot=self.protocol.step(question.step).moves_robot):
            return None
        ticked = self.operator.ticked(question, state)
        return OperatorAction(action="confirm", step=question.step, checklist=ticked, via="pedal")

    def _pedal_reading(self) -> PedalReading | None:
        lightbox = self.devices.lightbox()
        return None if lightbox is None else lightbox.pedal()

    def _opened(self, device: str, report: DeviceReport) -> None:
        self._run.append(DeviceOpened(device=device, report=dataclasses.asdict(report)))
        self._clocks.look()
