"""The jobs of a run that are due: of its registrations, and of the evaluation of those that arrived late."""

from __future__ import annotations

from service.core.jobs.keys import job_key, newest_job
from service.core.jobs.priorities import LATER, WAITED
from service.core.jobs.references import Reference
from service.core.protocol.models import Protocol, Step
from service.core.run.state import RunState
from service.jobs.kind import JobRecord
from service.jobs.registration import evaluate
from service.steps.context import JobRequest
from service.steps.poses.front_end import early_matches
from service.steps.poses.registration_jobs import RegistrationJobs, Task, name_of, recorded_registration_jobs
from service.steps.poses.sources import evaluated_step
from service.store.records import NewJob


class _Evaluated(JobRecord):
    """The registrations of an evaluation job by name, as recorded: values or references."""

    registrations: dict[str, object]


def evaluation_tasks(state: RunState, step: Step, found: RegistrationJobs | None) -> dict[str, Task]:
    """The evaluation jobs of registrations that arrived after the step's own evaluation, by registration.

    Args:
        state: of the run.
        step: the evaluation.
        found: the jobs of the registration step that it evaluates, as recorded; None if that has not begun them.
    """
    if step.gives != "accuracy" or state.steps[step.id].skipped:
        return {}
    own = [j for j in state.steps[step.id].jobs.values() if j.kind == evaluate.KIND.name and j.priority == WAITED]
    newest = max(own, key=lambda job: job.enqueued_seq, default=None)
    if newest is None or newest.status != "finished" or found is None:
        return {}
    tasks: dict[str, Task] = {}
    evaluated = _Evaluated.model_validate(newest.arguments).registrations
    for name, job in found.arrived.items():
        if name not in evaluated:
            arguments = {**newest.arguments, "registrations": {name: Reference(job.job, "result").record()}}
            key = f"{name}-{name_of(newest)}"
            request = JobRequest(evaluate.KIND.name, arguments, LATER, 2)
            tasks[name] = Task(key, request, newest_job(state, step.id, request.kind, key))
    return tasks


def due(protocol: Protocol, state: RunState) -> list[NewJob]:
    """All jobs that can be enqueued now because the results they need exist; none in an aborted run."""
    if state.status == "aborted":
        return []
    jobs = early_matches(protocol, state)
    recorded = {step.id: recorded_registration_jobs(protocol, state, step) for step in protocol.steps}
    for step in protocol.steps:
        found = recorded[step.id]
        tasks = [] if found is None else found.due
        if step.gives == "accuracy":
            late = evaluation_tasks(state, step, recorded[evaluated_step(step)])
            tasks += [task for task in late.values() if task.job is None]
        jobs += [new_job(state, step.id, task) for task in tasks]
    return jobs


def new_job(state: RunState, step: str, task: Task) -> NewJob:
    """The job to enqueue for a task."""
    key = job_key(state, step, task.request.kind, task.name)
    request = task.request
    return NewJob(
        request.kind,
        step,
        state.steps[step].attempt,
        key,
        request.arguments,
        priority=request.priority,
        version=request.version,
    )
