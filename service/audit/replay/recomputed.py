"""Stores the answers that a replay has computed as input of later jobs in its own folder; reports their drift."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from service.audit.record.run import RecordedFiles
from service.computations.job import JobAnswer
from service.computations.registration import ARM, REGISTER
from service.compute.registration.accuracy import true_error_m
from service.core.geometry import apply
from service.core.jobs import Reference, computed_by, jobs_of, resolve
from service.core.records.base import ArtefactRef
from service.core.records.run_events import JobFinished
from service.core.run.state import JobState, RunState, StepState
from service.core.units import mm
from service.dataset.summary import RunSummary
from service.store.artefacts import hash_file

_TELLING_DIGITS = 12  # a number with so many digits is recognised by its value, since nobody typed it
_TELLING_BITS = (
    32  # what rounding leaves of zero (-7 / 2**55) prints many digits, but two computations often meet in it
)


@dataclass
class CopiedResults:
    """Parts of the answers so far, by their content: an argument that equals a part was copied from there."""

    _parts: dict[str, Reference] = field(default_factory=dict[str, Reference])

    def add(self, job: JobState) -> None:
        """Add the answer of a finished job."""
        self._index(job.job, "result", job.result)

    def _index(self, job: str, path: str, value: Any) -> None:
        if _is_telling(value):
            self._parts[_key(value)] = Reference(job, path)
        if isinstance(value, Mapping):
            for name, item in cast("Mapping[str, Any]", value).items():
                self._index(job, f"{path}/{name}", item)
        elif isinstance(value, list | tuple):
            for index, item in enumerate(cast("Sequence[Any]", value)):
                self._index(job, f"{path}/{index}", item)

    def as_references(self, arguments: Any) -> Any:
        """Return the arguments with a reference in place of every copy."""
        if _is_telling(arguments):
            found = self._parts.get(_key(arguments))
            if found is not None:
                return found.record()
        if isinstance(arguments, Mapping):
            return {name: self.as_references(item) for name, item in cast("Mapping[str, Any]", arguments).items()}
        if isinstance(arguments, list | tuple):
            return [self.as_references(item) for item in cast("Sequence[Any]", arguments)]
        return arguments


def _key(value: Any) -> str:
    return json.dumps(value, sort_keys=True)


def _is_telling(value: Any) -> bool:
    """Return whether a value holds a number with so many digits that equality means a copy."""
    if isinstance(value, float):
        digits = repr(value).split("e")[0].replace("-", "").replace(".", "").strip("0")
        return len(digits) >= _TELLING_DIGITS and value.as_integer_ratio()[0].bit_length() >= _TELLING_BITS
    if isinstance(value, Mapping):
        return any(map(_is_telling, cast("Mapping[str, Any]", value).values()))
    return isinstance(value, list | tuple) and any(map(_is_telling, cast("Sequence[Any]", value)))


@dataclass(frozen=True, slots=True)
class Drift:
    """Displacement of the scan from its recorded registration, at the centre of its spheres."""

    registration: str
    in_world_mm: float | None  # drift by T_world_scan; None if the world frame is that of the reconstruction
    against_cameras_mm: float  # drift after aligning the cameras


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
        """Return a job's arguments with the recomputed answers of earlier jobs."""
        return self._with_new_hashes(resolve(self._copied.as_references(job.arguments), self._jobs))

    def _with_new_hashes(self, value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: self._with_new_hashes(item) for key, item in cast("Mapping[str, Any]", value).items()}
        if isinstance(value, list | tuple):
            return [self._with_new_hashes(item) for item in cast("Sequence[Any]", value)]
        return self.renamed.get(value, value) if isinstance(value, str) else value

    def measures_of(self, step: StepState) -> dict[str, float] | None:
        """Return a step's measures with the recomputed ones of its jobs; None if no job of it was computed again."""
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
    """Yield the drift of every registration that was computed again."""
    spheres = summary.scan_spheres_m()
    if not spheres:
        return
    centre_m = np.array(spheres, dtype=np.float64).mean(axis=0)
    for pair in recomputed.pairs:
        of_scan = summary.protocol.step(pair.step).gives == "registrations"  # the ground truth registers the CT, too
        if pair.before.kind != REGISTER.name or not of_scan:
            continue
        before, after = (REGISTER.read_answer(job.result) for job in (pair.before, pair.now))
        shared = sorted(before.T_scan_camera.keys() & after.T_scan_camera.keys())
        moved, given = (np.array([each.T_scan_camera[name] for name in shared]) for each in (after, before))
        in_world: float | None = None
        if before.poses in ARM:  # the world is the base of the first station
            places = [apply(np.array(each.T_world_scan), centre_m) for each in (before, after)]
            in_world = mm(float(np.linalg.norm(places[1] - places[0])))
        yield Drift(before.poses, in_world, mm(true_error_m(moved, given, centre_m)))


class ScratchStore:
    """The store that a job's handler sees during a replay."""

    def __init__(self, recorded: RecordedFiles, folder: Path) -> None:
        self._recorded = recorded
        self._folder = folder

    def artefact_path(self, sha256: str, *, verify: bool = False) -> Path:
        """Return a recomputed file, or else the recorded one. Raises IntegrityError."""
        own = self._folder / sha256
        return own if own.is_file() else self._recorded.artefact_path(sha256, verify=verify)

    def put_bytes(self, data: bytes, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        """Keep bytes in the scratch folder."""
        digest = hashlib.sha256(data).hexdigest()
        self._folder.mkdir(parents=True, exist_ok=True)
        (self._folder / digest).write_bytes(data)
        return ArtefactRef(
            sha256=digest, kind=kind, media_type=media_type, size_bytes=len(data), original_name=original_name
        )

    def put_file(self, path: Path, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        """Keep a copy of a file in the scratch folder."""
        digest, size = hash_file(path)
        self._folder.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, self._folder / digest)
        return ArtefactRef(
            sha256=digest, kind=kind, media_type=media_type, size_bytes=size, original_name=original_name
        )
