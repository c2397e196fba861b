"""What the events of jobs do to the state."""

from __future__ import annotations

from dataclasses import replace

from service.core.protocol.models import Protocol
from service.core.records.events import Event, JobEnqueued, JobFailed, JobFinished
from service.core.run.effects.place import impossible, is_void, without_effect
from service.core.run.persistent_map import put
from service.core.run.state import JobState, RunState
from service.core.run.state_transitions import change


def job_enqueued(protocol: Protocol, state: RunState, event: Event, p: JobEnqueued) -> RunState:
    """List a job of a step."""
    # A result that arrives after the run's end may still lead to further jobs.
    if is_void(state, event, p.step, p.attempt, when_completed=True):
        return without_effect(state, event)
    jobs = state.steps[p.step].jobs
    if p.job in jobs:
        raise impossible(event, f"job {p.job} is enqueued already")
    job = JobState(
        p.job,
        p.job_kind,
        p.attempt,
        event.seq,
        p.idempotency_key,
        p.arguments,
        priority=p.priority,
        enqueued_utc=event.at_utc,
    )
    return change(state, p.step, jobs=put(jobs, p.job, job))


def job_ended(protocol: Protocol, state: RunState, event: Event, p: JobFinished | JobFailed) -> RunState:
    """Keep a job's answer, or why it failed."""
    job = state.steps[p.step].jobs.get(p.job) if p.step in state.steps else None
    if job is None:
        if is_void(state, event, p.step, p.attempt):
            return without_effect(state, event)
        raise impossible(event, f"job {p.job} was never enqueued")
    if job.status == "finished":  # a second worker answered after a lost lease: the first answer counts
        return without_effect(state, event)
    if isinstance(p, JobFinished):
        done = {"measures": p.measures, "artefacts": p.artefacts, "result": p.result}
        job = replace(job, status="finished", duration_s=p.duration_s, late_s=p.late_s, **done)
    else:
        job = replace(job, status="failed", error=p.error, message=p.message)
    job = replace(job, ended_seq=event.seq, ended_utc=event.at_utc)
    return change(state, p.step, jobs=put(state.steps[p.step].jobs, p.job, job))
