"""Registrations of the recorded run, computed again with other arguments."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from service.audit.recorded_run import RecordedRun
from service.audit.replay import ScratchStore
from service.computations.job import JobAnswer, JobContext, RecordedContext
from service.computations.registration import REGISTER
from service.core.jobs import jobs_of, resolve
from service.core.run.state import JobState
from service.worker.loop import HANDLERS

ARM = ("robot", "robot_corrected")


def arm_jobs(run: RecordedRun) -> dict[str, JobState]:
    """The job of each registration of an arm's poses at full size."""
    jobs = [job for job in jobs_of(run.state).values() if job.kind == REGISTER.name]
    return {
        job.arguments["poses"]: job
        for job in jobs
        if job.arguments["poses"] in ARM and job.arguments.get("reduced_to") is None
    }


def computed(run: RecordedRun, job: JobState, folder: Path, more: Mapping[str, Any]) -> JobAnswer:
    """The job computed again with more arguments; its files are kept in the folder."""
    arguments: Mapping[str, Any] = {**resolve(job.arguments, jobs_of(run.state)), **more}
    context: RecordedContext = JobContext(
        arguments, ScratchStore(run.files, folder), folder / "scratch", lambda *_: None
    )
    return HANDLERS[job.kind](context)


def without_mount(job: JobState) -> JobState:
    """The job as if the camera's mount were unknown, so that each image is located by its spheres."""
    unknown = {"poses": "spheres", "T_flange_camera": None, "arm_correction": None}
    return dataclasses.replace(job, arguments={**job.arguments, **unknown})
