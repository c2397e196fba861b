"""The sources of camera poses, and which jobs lead from the images to a registration with each of them.

Nothing is enqueued here: from the record it follows which jobs are due. The step enqueues them, and after it the
worker, each time a job has ended, so that results arrive when nobody drives the run any more.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, cast

import numpy as np
from pydantic import BaseModel

from service.compute.poses.sfm.front_end import pairs_of
from service.compute.poses.sfm.options import SfmOptions
from service.core.jobs.keys import arguments_name, job_key, newest_job
from service.core.jobs.priorities import LATER, REDUCED, WAITED
from service.core.jobs.references import Reference, jobs_of, resolve
from service.core.protocol.models import Protocol, Step
from service.core.run.state import JobState, RunState
from service.jobs import job_kinds
from service.jobs.records import Photograph
from service.steps.context import JobRequest
from service.steps.poses.front_end import IMAGES_A_JOB, PAIRS_A_JOB, Early, chunks, early_matches, found_early
from service.store.records import NewJob

# "robot" is what the paper compares with: the arm's poses as reported. "robot_corrected" takes off what the hand-eye
# calibration found of the arm's errors, and what the spheres show of each pose's. "spheres" places each image of a
# hand-held camera by the spheres that it shows, before any registration. "triangulated" adjusts what the images have
# in common, beginning with the corrected robot poses; COLMAP and GLOMAP begin with nothing.
Source = Literal["robot", "robot_corrected", "spheres", "triangulated", "colmap", "glomap", "hybrid"]
DEFAULT_SOURCES: tuple[Source, ...] = ("robot", "robot_corrected", "triangulated", "colmap", "glomap", "hybrid")
PLANNED = "sources_planned"  # name of the note with which a registration says what it decides by and what comes later

_REDUCED = ("reduced_to", "full_camera")  # arguments of jobs on reduced images; the second in old runs
_QUICK = ("robot", "robot_corrected", "spheres")  # seconds: they need the outlines alone
_BY_PREFERENCE = ("robot_corrected", "robot", "spheres", "triangulated", "colmap", "glomap", "hybrid")
_MAPPERS = {"colmap": "incremental", "glomap": "global", "triangulated": "triangulated"}


@dataclass(frozen=True, slots=True)
class Wanted:
    """What the parameters of a registration step ask for."""

    poses: tuple[str, ...]
    reduced: tuple[str, ...]  # 1920x1080
    reduced_poses: tuple[str, ...]
    effort: Mapping[str, Any]

    @classmethod
    def of(cls, params: BaseModel) -> Wanted:
        """Of a registration step's params."""
        fields = params.model_dump(mode="json")
        names = ("poses", "reduced", "reduced_poses")
        poses, reduced, reduced_poses = (tuple(cast("list[str]", fields[name])) for name in names)
        return cls(poses, reduced, reduced_poses, fields["structure_from_motion"])

    @property
    def registrations(self) -> dict[str, tuple[str, str]]:
        """Source and size ("" for the full one) of every registration, by its name."""
        full = {source: (source, "") for source in self.poses}
        return full | {f"{p}_{size}": (p, size) for size in self.reduced for p in self.reduced_poses}


def decisive(protocol: Protocol, step: Step) -> tuple[str, ...]:
    """The registrations that a registration step waits for: those that gates name, and those that take seconds."""
    names = Wanted.of(step.params).registrations
    judging = [
        s for s in protocol.steps if s.kind == "evaluation" and s.params.model_dump()["registration"] == step.id
    ]
    measures = [gate.measure for s in (step, *judging) for gate in s.gates]
    waited = {name for measure in measures for name in _named(measure, names)} | {n for n in names if n in _QUICK}
    if not waited:
        waited = {next((name for name in _BY_PREFERENCE if name in names), next(iter(names)))}
    return tuple(name for name in names if name in waited)


def _named(measure: str, names: Iterable[str]) -> list[str]:
    """The longest name with which a measure begins: `robot_corrected_rms_px` is none of `robot`."""
    found = sorted((name for name in names if measure.startswith(f"{name}_")), key=len)
    return found[-1:]


def posed(images: Iterable[Photograph]) -> bool:
    """Whether a robot, or the spheres, tell where the camera was; else the images alone do."""
    return any(image.T_base_flange is not None or image.T_scene_camera is not None for image in images)


@dataclass(frozen=True, slots=True)
class Task:
    """A job on the way to a registration, and how it stands; `job` is None while it is still to be enqueued."""

    name: str  # of the job's key
    request: JobRequest
    job: JobState | None


@dataclass(frozen=True, slots=True)
class Ways:
    """How the registrations of a step stand."""

    tasks: tuple[Task, ...]
    ways_to: Mapping[str, tuple[Task, ...]]  # those that lead to each registration, in order
    arrived: Mapping[str, JobState]  # the job `register` of each
    failed: Mapping[str, str]  # why there will be none

    @property
    def due(self) -> list[Task]:
        """What can be enqueued now."""
        return [task for task in self.tasks if task.job is None]


def ways(state: RunState, step: str, wanted: Wanted, waited: Iterable[str], outlines: JobRequest, root: str) -> Ways:
    """Every job that can be named by now, for every registration.

    Args:
        state: the run's.
        step: of the registration.
        wanted: by its parameters.
        waited: names of the registrations that the step waits for.
        outlines: the job that everything begins with; its arguments have what all have in common.
        root: the name of that job, which keeps apart what begins with other images.
    """
    walk = _Walk(state, step, wanted, outlines, root)
    urgent = set(waited)
    arrived: dict[str, JobState] = {}
    for name, (source, size) in sorted(wanted.registrations.items(), key=lambda item: item[0] not in urgent):
        priority = WAITED if name in urgent else REDUCED if size else LATER
        job = walk.to_registration(name, source, size, priority)
        if job is not None:
            arrived[name] = job
    ways_to = {name: tuple(walk.tasks[key] for key in keys) for name, keys in walk.ways_to.items()}
    return Ways(tuple(walk.tasks.values()), ways_to, arrived, walk.failed)


@dataclass
class _Walk:
    """From the images to each registration, as far as results are there."""

    state: RunState
    step: str
    wanted: Wanted
    outlines: JobRequest
    root: str
    tasks: dict[tuple[str, str], Task] = field(default_factory=dict[tuple[str, str], Task])
    ways_to: dict[str, list[tuple[str, str]]] = field(default_factory=dict[str, list[tuple[str, str]]])
    failed: dict[str, str] = field(default_factory=dict[str, str])
    jobs: Mapping[str, JobState] = field(default_factory=dict[str, JobState])
    _for: str = ""
    _priority: int = WAITED

    def __post_init__(self) -> None:
        self.jobs = jobs_of(self.state)

    def to_registration(self, name: str, source: str, size: str, priority: int) -> JobState | None:
        """The finished job `register`, or None; what is needed for it is among the tasks."""
        self._for, self._priority = name, priority
        if size and (reason := self._no_reduction(size)):
            self.failed[name] = reason
            return None
        return self._registered(source, size)

    def _no_reduction(self, size: str) -> str:
        """Why a size cannot be compared with the full one, or nothing: a protocol serves cameras of any size."""
        width, height = _pixels(size)
        camera = resolve(self.outlines.arguments["camera"], self.jobs)
        # Else at least one side is cut only, at the full scale.
        if width < camera["width"] and height < camera["height"]:
            return ""
        return f"{width} × {height} does not reduce photographs of {camera['width']:g} × {camera['height']:g} px"

    def _registered(self, source: str, size: str) -> JobState | None:
        search = self._arguments(size)
        shared = {key: value for key, value in search.items() if key not in ("detector", "colour")}
        if not posed(map(Photograph.model_validate, search["images"])):
            first = self._model(self._mapper(""), size, shared)  # the poses come first, then the spheres
            if first is None:
                return None
            search["model"] = first["model"]
        detected = self._need("detect_spheres", "", size, search)
        if detected is None:
            return None
        markers = {**shared, "outlines": detected.artefacts[0].sha256, "poses": source}
        if source in _QUICK:
            reported: dict[str, Any] = {"arm_correction": None} if source == "robot" else {}
            return self._need("register", source, size, {**markers, **reported})
        model = self._model(self._mapper(source), size, shared)
        if model is not None and source == "hybrid":
            # It starts from one reconstruction and adds the robot and the spheres.
            adjusted = self._need("hybrid", source, size, {**markers, **model})
            model = None if adjusted is None else {"model": adjusted.artefacts[0].sha256}
        return None if model is None else self._need("register", source, size, {**markers, **model})

    def _mapper(self, source: str) -> str:
        """The mapper of a source; what has none of its own begins with one that runs in any case."""
        wanted = [mapper for other, mapper in _MAPPERS.items() if other in self.wanted.poses]
        return _MAPPERS.get(source) or next(iter(wanted), "incremental")

    def _model(self, mapper: str, size: str, shared: Mapping[str, Any]) -> dict[str, str] | None:
        """Poses and tracks of structure from motion, as arguments of what goes on from there."""
        known = next((source for source in reversed(_QUICK) if source in self.wanted.poses), None)
        prior = None
        if known is not None:
            # Registered robot poses share one frame over both stations: they tell which images see the same thing.
            registered = self._registered(known, "")
            if registered is None:
                return None
            prior = Reference(registered.job, "result/T_scan_camera")
        pieces = self._pieces(size, shared, prior)
        if pieces is None:
            return None
        arguments = {**shared, **pieces, "mappers": [mapper], "effort": dict(self.wanted.effort)}
        arguments["prior"] = None if prior is None else prior.record()
        made = self._need("structure_from_motion", mapper, size, arguments)
        if made is None:
            return None
        refs = {ref.original_name: ref.sha256 for ref in made.artefacts}
        return {"model": refs[f"{mapper}.json"], "tracks": refs[f"{mapper}_tracks.npz"]}

    def _pieces(self, size: str, shared: Mapping[str, Any], prior: Reference | None) -> dict[str, Any] | None:
        """Features and matches as arguments: those that were made while the images arrived, and the others."""
        effort = dict(self.wanted.effort)
        common = {"camera": shared["camera"], "effort": effort}
        common |= {name: shared[name] for name in _REDUCED if name in shared}
        images = [{"viewpoint": image["viewpoint"], "sha256": image["sha256"]} for image in shared["images"]]
        early = Early() if size else found_early(self.state, self.jobs, resolve(shared["camera"], self.jobs), effort)
        jobs: list[JobState | None] = [
            early.features[image["sha256"]] for image in images if image["sha256"] in early.features
        ]
        rest = [image for image in images if image["sha256"] not in early.features]
        for some in chunks(rest, IMAGES_A_JOB):
            what = arguments_name({"images": [image["sha256"] for image in some]})
            jobs.append(self._need("features", what, size, {**common, "images": some}))
        made = [job for job in jobs if job is not None and job.status == "finished"]
        if len(made) < len(jobs):
            return None
        by_image: dict[str, str] = {}
        for job in made:
            these = zip(job.arguments["images"], job.artefacts, strict=True)
            by_image |= {image["sha256"]: ref.sha256 for image, ref in these}
        features = {image["viewpoint"]: by_image[image["sha256"]] for image in images}
        matched: list[JobState | None] = [*early.matching(features)]
        done = {(a, b) for job in early.matching(features) for a, b in job.arguments["pairs"]}
        known = {} if prior is None else {name: np.array(T) for name, T in resolve(prior.record(), self.jobs).items()}
        left = [pair for pair in pairs_of(features, known or None, SfmOptions(**effort)) if pair not in done]
        for pairs in chunks(left, PAIRS_A_JOB):
            mine = {name: features[name] for pair in pairs for name in pair}
            listed = [list(pair) for pair in pairs]
            what = arguments_name({"pairs": listed})
            matched.append(self._need("match", what, size, {**common, "features": mine, "pairs": listed}))
        finished = [job for job in matched if job is not None and job.status == "finished"]
        if len(finished) < len(matched):
            return None
        return {"features": features, "matches": [job.artefacts[0].sha256 for job in finished]}

    def _arguments(self, size: str) -> dict[str, Any]:
        """Of the search for outlines at a size; everything else has most of them in common."""
        arguments = dict(self.outlines.arguments)
        arguments.pop("model", None)  # of a search that began with poses from the images alone
        if not size:
            return arguments
        width, height = _pixels(size)
        arguments.pop("intrinsics_covariance", None)  # it is of the full size
        return arguments | {"reduced_to": [width, height]}

    def _need(self, kind: str, what: str, size: str, arguments: Mapping[str, Any]) -> JobState | None:
        """The finished job of this work; None while there is none, or where it has failed."""
        name = "-".join(part for part in (what, size, self.root) if part)
        job = newest_job(self.state, self.step, kind, name)
        if job is not None and job.status == "failed":
            if job.attempt == self.state.steps[self.step].attempt:
                self.failed.setdefault(self._for, f"{kind.replace('_', ' ')}: {job.message}")
            else:
                job = None  # a repeated step tries it again
        mine = self.ways_to.setdefault(self._for, [])
        if (kind, name) not in mine:
            mine.append((kind, name))
        request = JobRequest(kind, arguments, self._priority, job_kinds()[kind].version)
        self.tasks.setdefault((kind, name), Task(name, request, job))
        return job if job is not None and job.status == "finished" else None


def _pixels(size: str) -> tuple[int, int]:
    """Width and height of 1920x1080."""
    width, _, height = size.partition("x")
    return int(width), int(height)


# --- what is due, whoever asks ------------------------------------------------------------------------------------


def registration_ways(protocol: Protocol, state: RunState, step: Step) -> Ways | None:
    """How the registrations of a step stand, by the record alone; None for a step that has not begun them.

    None also for a run that was recorded when a registration waited for all of its sources.
    """
    now = state.steps[step.id]
    if step.kind != "registration" or now.skipped or all(note.note != PLANNED for note in now.notes):
        return None
    begun = [j for j in now.jobs.values() if j.kind == "detect_spheres" and not set(_REDUCED) & set(j.arguments)]
    if not begun:
        return None
    newest = max(begun, key=lambda job: job.enqueued_seq)
    outlines = JobRequest(newest.kind, newest.arguments, newest.priority, 2)
    wanted = Wanted.of(step.params)
    return ways(state, step.id, wanted, decisive(protocol, step), outlines, name_of(newest))


def evaluation_tasks(protocol: Protocol, state: RunState, step: Step) -> dict[str, Task]:
    """The evaluation of every registration that arrived after the step's own evaluation, by registration."""
    if step.kind != "evaluation" or state.steps[step.id].skipped:
        return {}
    own = [j for j in state.steps[step.id].jobs.values() if j.kind == "evaluate" and j.priority == WAITED]
    newest = max(own, key=lambda job: job.enqueued_seq, default=None)
    found = registration_ways(protocol, state, protocol.step(step.params.model_dump()["registration"]))
    if newest is None or newest.status != "finished" or found is None:
        return {}
    tasks: dict[str, Task] = {}
    for name, job in found.arrived.items():
        if name not in newest.arguments["registrations"]:
            arguments = {**newest.arguments, "registrations": {name: Reference(job.job, "result").record()}}
            key = f"{name}-{name_of(newest)}"
            request = JobRequest("evaluate", arguments, LATER, 2)
            tasks[name] = Task(key, request, newest_job(state, step.id, "evaluate", key))
    return tasks


def due(protocol: Protocol, state: RunState) -> list[NewJob]:
    """The jobs that can be enqueued now because the results they need are there; none in an aborted run."""
    if state.status == "aborted":
        return []
    jobs = early_matches(protocol, state)
    for step in protocol.steps:
        found = registration_ways(protocol, state, step)
        tasks = [] if found is None else found.due
        tasks += [task for task in evaluation_tasks(protocol, state, step).values() if task.job is None]
        jobs += [new_job(state, step.id, task) for task in tasks]
    return jobs


def new_job(state: RunState, step: str, task: Task) -> NewJob:
    """A task as it is enqueued."""
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


def name_of(job: JobState) -> str:
    """What tells a job from others of its kind, out of its key."""
    return job.idempotency_key.split("/")[3]
