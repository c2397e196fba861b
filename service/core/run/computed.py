"""The jobs that computed a step's measures and its result."""

from __future__ import annotations

from collections.abc import Iterator

from service.core.records.events import ComputedBy
from service.core.run.state import JobState, StepState


def computed_by(state: StepState) -> tuple[ComputedBy, ...]:
    """The jobs whose figures a step reported as its own, as its event names them.

    Events of older versions do not name them; there, a job is recognised by the values that it shares with the step.
    """
    return tuple(_by_values(state)) if state.computed_by is None else state.computed_by


def answered_by(state: StepState) -> JobState | None:
    """The newest job whose answer is part of the step's result; None if no job computed it."""
    found = [state.jobs[source.job] for source in computed_by(state) if source.job in state.jobs]
    for job in sorted(found, key=lambda job: job.enqueued_seq, reverse=True):
        if job.result and job.result.keys() <= state.result.keys():
            return job
    return None


def _by_values(state: StepState) -> Iterator[ComputedBy]:
    for job in state.jobs.values():
        if job.status != "finished":
            continue
        if job.result and all(state.result.get(name) == value for name, value in job.result.items()):
            yield ComputedBy(job=job.job)
        elif (prefix := _prefix(state, job)) is not None:
            yield ComputedBy(job=job.job, prefix=prefix)


def _prefix(state: StepState, job: JobState) -> str | None:
    """What stands before the names of the job's measures in the step's; None if these are not its measures."""
    first = next(iter(job.measures), None)
    if first is None:
        return None
    for name in state.measures:
        prefix = name.removesuffix(first)
        if name.endswith(first) and all(
            state.measures.get(prefix + own) == job.measures[own] for own in job.measures
        ):
            return prefix
    return None
