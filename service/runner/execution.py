"""Executes one step: makes its context, and records its outcome or failure."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from drivers.errors import DeviceError
from service.core.errors import OrthocaptureError, UnforeseenError
from service.core.protocol.models import Protocol, Step
from service.core.records.base import recorded
from service.core.records.events import DeviceTrouble, Payload, StepFailed, StepMeasured
from service.core.recovery.policy import recovery_policy
from service.core.run.state import JobState
from service.core.text.counts import counted
from service.logs.where import at
from service.monitor.worker_sign import living_workers
from service.run_record import StepEvidence
from service.runner.disk import DiskWatch
from service.runner.held_run import HeldRun
from service.runner.leave import LeaveWatch
from service.runner.operator import Operator
from service.steps import step_kinds
from service.steps.context import Devices, LeaveToMove, StepContext, StepInterruptedError, StepOutcome
from service.store.durable_effects import Clock, moment_of

_LOG = logging.getLogger(__name__)
_NOBODY_S = 30.0  # a worker that died has been replaced by then
_TOLD_AGAIN_S = 300.0
_EVERY_S = 5.0


@dataclass
class WorkerWatch:
    """Notices that jobs of a step wait and no worker runs, and tells the operator, from time to time again."""

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

    def execute(self, step_id: str, attempt: int) -> None:
        """Execute a step and record its outcome or failure; an interruption by an operator is only told."""
        step = self.protocol.step(step_id)
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
            self._failed(step_id, attempt, error)
        except Exception as error:
            # A step that reads strangers' files may not end the run. One that moves the robot may: then the arm's
            # watchdog no longer hears of this program, and stops it.
            if step.moves_robot:
                raise
            _LOG.info("%s", step_id, exc_info=True)  # below what the terminal shows
            self._failed(step_id, attempt, _unforeseen(step_id, error))
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
            evidence=StepEvidence(
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

    def _failed(self, step_id: str, attempt: int, error: OrthocaptureError) -> None:
        self.note_connections()
        state = self.run.refresh().steps[step_id]
        name = type(error).__name__
        policy = recovery_policy(self.protocol.step(step_id).recovery, name, state.failures + 1)
        payloads: list[Payload] = []
        if isinstance(error, DeviceError):
            payloads.append(DeviceTrouble(device=error.where or step_id, error=name, message=str(error)))
        payloads.append(StepFailed(step=step_id, attempt=attempt, error=name, message=str(error), recovery=policy))
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


def _unforeseen(step_id: str, error: Exception) -> UnforeseenError:
    return UnforeseenError(
        f"this was not foreseen: {type(error).__name__}: {error}",
        where=str(getattr(error, "filename", None) or f"step {step_id}"),
        remedy="Take the file away that it was about, or use another one, then repeat the step; the log says more",
    )
