"""The answers that a replay has computed, as input of later jobs, and how far the final registrations drift."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from service.audit.replay.copied import CopiedResults
from service.compute.evaluation.accuracy import true_error_m
from service.core.geometry import apply
from service.core.jobs import computed_by, jobs_of, resolve
from service.core.records.events import JobFinished
from service.core.run.state import JobState, RunState, StepState
from service.core.units import mm
from service.dataset.summary import RunSummary
from service.jobs.registration import register
from service.worker.job import JobAnswer


@dataclass(frozen=True, slots=True)
class Drift:
    """Displacement of the scan from its recorded registration, at the centre of its spheres."""

    registration: str
    in_world_mm: float | None  # by T_world_scan; None if the world frame is that of the reconstruction
    against_cameras_mm: float  # after aligning the cameras


@dataclass(frozen=True, slots=True)
class _Pair:
    """A job as recorded, and as computed again."""

    step: str
    before: JobState
    now: JobState


class RecomputedJobs:
    """The jobs of a run with the answers of the replay."""

    def __init__(self, state: RunState) -> None:
        self.renamed: dict[str, str] = {}  # hash of a recorded file → hash of the file written again, if it differs
        self.pairs: list[_Pair] = []
        self._jobs = jobs_of(state)
        self._copied = CopiedResults()

    def add(self, step: str, job: JobState, now: JobFinished, answer: JobAnswer) -> None:
        """Add a recomputed job, in the order of the jobs; `now` as its event would be."""
        again = replace(job, measures=now.measures, result=now.result, artefacts=answer.artefacts)
        for old, new in zip(job.artefacts, answer.artefacts, strict=False):
            if old.sha256 != new.sha256:
                self.renamed[old.sha256] = new.sha256
        self._copied.add(job)
        self._jobs[job.job] = again
        self.pairs.append(_Pair(step, job, again))

    def arguments(self, job: JobState) -> Mapping[str, Any]:
        """A job's arguments with the recomputed answers of earlier jobs."""
        return self._with_new_hashes(resolve(self._copied.as_references(job.arguments), self._jobs))

    def _with_new_hashes(self, value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: self._with_new_hashes(item) for key, item in cast("Mapping[str, Any]", value).items()}
        if isinstance(value, list | tuple):
            return [self._with_new_hashes(item) for item in cast("Sequence[Any]", value)]
        return self.renamed.get(value, value) if isinstance(value, str) else value

    def measures_of(self, step: StepState) -> dict[str, float] | None:
        """A step's measures with the recomputed measures of its jobs; None if no job of it was computed again."""
        pairs = {pair.before.job: pair for pair in self.pairs if pair.step == step.step}
        if not pairs:
            return None
        measures = dict(step.measures)
        for source in computed_by(step):
            if source.job in pairs:
                again = pairs[source.job].now.measures
                measures |= {source.prefix + name: float(value) for name, value in again.items()}
        return {name: value for name, value in measures.items() if name in step.measures}


def drifts(summary: RunSummary, recomputed: RecomputedJobs) -> Iterator[Drift]:
    """The drift of every registration that was computed again."""
    spheres = summary.scan_spheres_m()
    if not spheres:
        return
    centre_m = np.array(spheres, dtype=np.float64).mean(axis=0)
    for pair in recomputed.pairs:
        of_scan = summary.protocol.step(pair.step).gives == "registrations"  # the ground truth registers the CT, too
        if pair.before.kind != register.KIND.name or not of_scan:
            continue
        before, after = (register.KIND.read_answer(job.result) for job in (pair.before, pair.now))
        shared = sorted(before.T_scan_camera.keys() & after.T_scan_camera.keys())
        moved, given = (np.array([each.T_scan_camera[name] for name in shared]) for each in (after, before))
        in_world: float | None = None
        if before.poses in register.ARM:  # the world is the base of the first station
            places = [apply(np.array(each.T_world_scan), centre_m) for each in (before, after)]
            in_world = mm(float(np.linalg.norm(places[1] - places[0])))
        yield Drift(before.poses, in_world, mm(true_error_m(moved, given, centre_m)))
