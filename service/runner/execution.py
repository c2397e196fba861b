"""Executes one step: makes its context, and records its outcome or failure."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Protocol as Interface

from drivers.errors import DeviceError
from drivers.machine_pressure import HeldUp
from service.core.errors import OrthocaptureError, UnforeseenError
from service.core.protocol import Protocol, Step
from service.core.records.base import recorded
from service.core.records.events import Payload
from service.core.records.run_events import DeviceTrouble, StepFailed, StepMeasured, StepNote
from service.core.recovery import TRIED_AGAIN, recovery_policy
from service.core.run.state import JobState
from service.core.words import counted
from service.logs import at
from service.monitor.snapshot import living_workers
from service.runner.held_run import HeldRun, Operator
from service.runner.leave import LeaveWatch
from service.runner.upkeep import DiskWatch
from service.steps import step_kinds
from service.steps.context import Devices, Evidence, LeaveToMove, StepContext, StepInterruptedError, StepOutcome
from service.store.durable_effects import Clock, moment_of

_LOG = logging.getLogger(__name__)
_NOBODY_S = 30.0  # a worker that died has been replaced by then
_TOLD_AGAIN_S = 300.0
_EVERY_S = 5.0
# A machine is short of processors if this program could not run for this share of the time in which it wanted to, and
# for a second at least.
_SHORT_SHARE, _SHORT_S = 0.4, 1.0


class Starvation(Interface):
    """The time for which this program was prevented from running, since it was made."""

    @property
    def seconds(self) -> float:
        """The longest time that one of its threads has waited."""
        ...

    @property
    def share(self) -> float:
        """The part, 0 to 1, of the time in which it wanted to run and could not."""
        ...


def held_up_here() -> Starvation:
    """Measure this program from now on."""
    return HeldUp("self")


@dataclass
class WorkerWatch:
    """Notices that jobs of a step wait and no worker runs, and warns the operator, from time to time again."""

    data: Path
    tell: Callable[[str], None]
    clock: Clock
    _look_at_s: float = field(default=-math.inf, init=False)
    _tell_at_s: float | None = field(default=None, init=False)

    def look(self, jobs: Collection[JobState]) -> None:
        """Look at the jobs of the step under way. Called again and again; looks every few seconds."""
        now_s = self.clock.monotonic_s()
        if now_s < self._look_at_s:
            return
        self._look_at_s = now_s + _EVERY_S
        open_jobs = sum(job.status == "enqueued" for job in jobs)
        if not open_jobs or living_workers(self.data, self.clock):
            self._tell_at_s = None
            return
        if self._tell_at_s is None:
            self._tell_at_s = now_s + _NOBODY_S
        if now_s >= self._tell_at_s:
            self._tell_at_s = now_s + _TOLD_AGAIN_S
            waiting = f"{counted(open_jobs, 'computation')} wait{'s' if open_jobs == 1 else ''}"
            self.tell(f"{waiting}, and no worker is running. Start one with `orthocapture worker --data {self.data}`")


@dataclass(frozen=True)
class StepExecution:
    """Executes steps of a held run with the devices of its rig."""

    run: HeldRun
    protocol: Protocol
    devices: Devices
    operator: Operator
    disk: DiskWatch
    workers: WorkerWatch
    leave: LeaveWatch
    clock: Clock
    held_up: Callable[[], Starvation] = held_up_here

    def execute(self, step_id: str, attempt: int) -> None:
        """Execute a step and record its outcome or failure; an interruption by an operator is only reported.

        No error of a step ends the run: after one that nobody foresaw the arms stand, and a person is asked.
        """
        step = self.protocol.step(step_id)
        starvation = self.held_up()
        at(step=step_id, viewpoint="")
        checkpoint = partial(self._checkpoint, step_id, attempt)
        context = self._context(step, attempt, checkpoint)
        self.leave.attempt()
        if (leave := self.run.state.leave) is not None:
            self.devices.let_move(LeaveToMove(leave.seq, leave.by, self.run.follower.leave_not_before_s))
        try:
            checkpoint()
            if step.needs_disk:
                self.disk.require()
            outcome = step_kinds()[step.kind].execute(context, step.params)
        except StepInterruptedError as interruption:
            self.operator.tell(str(interruption))
        except OrthocaptureError as error:
            self.failed(step_id, attempt, error, starvation)
        except Exception as error:  # noqa: BLE001 - of a library, over a stranger's file, say
            _LOG.info("%s", step_id, exc_info=True)  # below what the terminal shows
            if step.moves_robot:
                self.devices.hold_arms()
            self.failed(step_id, attempt, _unforeseen(step, error), starvation)
        else:
            self._measured(step_id, attempt, outcome)

    def note_connections(self) -> None:
        """Record which connections to arms have ended."""
        for end in self.devices.ended_connections():
            self.run.append(
                DeviceTrouble(device=end.device, error=end.error, message=end.message, connection=end.how)
            )

    def _context(self, step: Step, attempt: int, checkpoint: Callable[[], None]) -> StepContext:
        operator = self.operator
        return StepContext(
            protocol=self.protocol,
            step=step,
            attempt=attempt,
            run=self.run.state,
            devices=self.devices,
            evidence=Evidence(
                self.run.follower,
                self.run.lease,
                step.id,
                attempt,
                checkpoint,
                self._show,
                self.leave.wait_for_results,
                self.disk.require,
            ),
            checkpoint=checkpoint,
            progress=self._show,
            monotonic_s=self.clock.monotonic_s,
            wait=self.clock.sleep,
            operator=operator.name,
            tell=operator.tell,
            moment=partial(moment_of, self.clock),
            motion=self.leave.motion,
            wait_for_results=self.leave.wait_for_results,
            busy=operator.busy,
        )

    def _show(self, what: str, done: int, total: int) -> None:
        self.leave.progress(what, done)
        self.operator.show(what, done, total)

    def _measured(self, step: str, attempt: int, outcome: StepOutcome) -> None:
        self.run.append(
            StepMeasured(
                step=step,
                attempt=attempt,
                measures=outcome.measures.plain(),
                artefacts=outcome.artefacts,
                result={} if outcome.result is None else recorded(outcome.result),
                uncertainties=dict(outcome.uncertainties),
                computed_by=outcome.computed_by,
            )
        )

    def failed(
        self, step_id: str, attempt: int, error: OrthocaptureError, starvation: Starvation | None = None
    ) -> None:
        """Record that a step failed, and what follows; `starvation` is that of this program during the attempt."""
        self.note_connections()
        state = self.run.refresh().steps[step_id]
        name = type(error).__name__
        short = name in TRIED_AGAIN and starvation is not None and _short(starvation)
        policy = recovery_policy(self.protocol.step(step_id).recovery, name, state.failures + 1, starved=short)
        payloads: list[Payload] = []
        message = str(error)
        if short and starvation is not None:
            lacked = {"waited_s": round(starvation.seconds, 1), "share": round(starvation.share, 2)}
            payloads.append(StepNote(step=step_id, attempt=attempt, note="processor_short", data=lacked))
            message += (
                f". This computer is short of processor time: the program wanted to run and could not for "
                f"{lacked['waited_s']:.0f} s, {100 * lacked['share']:.0f} % of the time"
            )
        if isinstance(error, DeviceError):
            payloads.append(DeviceTrouble(device=error.where or step_id, error=name, message=str(error)))
        payloads.append(StepFailed(step=step_id, attempt=attempt, error=name, message=message, recovery=policy))
        self.run.append(*payloads)
        kept = self.run.state.origin
        self.operator.tell(f"{step_id}: {error}. What was {kept} is safe")

    def _checkpoint(self, step: str, attempt: int) -> None:
        """Called by steps wherever they may stop. Raises StepInterruptedError if an operator paused or ended it."""
        self.note_connections()
        state = self.run.refresh()
        self.leave.look(state)
        self.operator.attend("pausing" if state.paused else "working", state, pedal_armed=False)
        self.workers.look(state.steps[step].jobs.values())
        if state.paused:
            raise StepInterruptedError("paused")
        if state.terminal or (state.current, state.step.attempt, state.phase) != (step, attempt, "running"):
            raise StepInterruptedError(f"the operator has ended this attempt; the run is {state.status}")


def _short(starvation: Starvation) -> bool:
    return starvation.seconds >= _SHORT_S and starvation.share >= _SHORT_SHARE


def _unforeseen(step: Step, error: Exception) -> UnforeseenError:
    if step.moves_robot:
        remedy = "The robot was stopped and moves for nobody until you confirm: look at it, then repeat the step"
    else:
        remedy = "Take the file away that it was about, or use another one, then repeat the step"
    return UnforeseenError(
        f"this was not foreseen: {type(error).__name__}: {error}",
        where=str(getattr(error, "filename", None) or f"step {step.id}"),
        remedy=f"{remedy}; the log says more",
    )
