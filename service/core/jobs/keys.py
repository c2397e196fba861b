"""Idempotency keys of jobs: the same work has the same key, so a restart or retry reuses its result."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from service.core.run.state import JobState, RunState


def arguments_name(arguments: Mapping[str, Any]) -> str:
    """A hash of the arguments, 16 hexadecimal digits: equal arguments have the same name."""
    return hashlib.sha256(json.dumps(arguments, sort_keys=True).encode()).hexdigest()[:16]


def key_stem(state: RunState, step: str, kind: str) -> str:
    """The common prefix of the keys of all jobs of this kind that were enqueued since the step's last redo."""
    generation = sum(past.step == step and past.viewpoint is None for past in state.superseded)
    return f"{step}/{generation}/{kind}/"


def job_key(state: RunState, step: str, kind: str, name: str) -> str:
    """The key under which a job would be enqueued now.

    A redo of the step begins a new generation of keys; a failed job is tried again under a new key.
    """
    stem = f"{key_stem(state, step, kind)}{name}/"
    jobs = state.steps[step].jobs.values()
    return stem + str(sum(job.idempotency_key.startswith(stem) and job.status == "failed" for job in jobs))


def newest_job(state: RunState, step: str, kind: str, name: str) -> JobState | None:
    """The last job for this work enqueued since the step's last redo, or None."""
    stem = f"{key_stem(state, step, kind)}{name}/"
    jobs = [job for job in state.steps[step].jobs.values() if job.idempotency_key.startswith(stem)]
    return max(jobs, key=lambda job: job.enqueued_seq, default=None)
