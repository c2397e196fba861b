"""The jobs that lead from the images to each registration of a step, planned from the record.

Nothing is enqueued here. The step enqueues the jobs that are due; once it has ended, the worker does so after each
job, so that results still arrive when no process drives the run any more.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, TypeVar

import numpy as np

from service.computations import detect_spheres, further_camera, job_kinds
from service.computations.features import FrontEndArguments, ImagesToMatch, SfmEffort
from service.computations.kind import JobRecord, read_part
from service.computations.match import PairsToMatch
from service.computations.records import Camera, ImageFile, ImagesCamera, PosedPhotograph
from service.compute.sfm.options import SfmOptions, pairs_of
from service.core.jobs import Jobs, Reference, arguments_name, jobs_of, newest_job, resolve
from service.core.protocol.models import Protocol, Step
from service.core.records.events import FurtherExposure, ViewpointCaptured
from service.core.run.state import EARLY, LATER, REDUCED, WAITED, JobState, RunState
from service.steps.context import JobRequest, JobResult, StepContext
from service.steps.registration import (
    PLANNED,
    QUICK,
    RegistrationParams,
    decisive,
    developed,
    exposure_of,
    most_preferred,
    posed,
)

T = TypeVar("T")
_REDUCED = ("reduced_to", "full_camera")  # arguments of jobs on reduced images; the second one in old runs only
_SEARCH_ONLY = ("detector", "colour", "developed")  # arguments of the search for outlines alone
_IMAGES_A_JOB, _PAIRS_A_JOB = 8, 100  # in the jobs that complete features and matches
_MAPPERS = {"colmap": "incremental", "glomap": "global", "triangulated": "triangulated"}


@dataclass(frozen=True, slots=True)
class Task:
    """A job that a registration needs; `job` is None until it is enqueued."""

    name: str  # the name in the job's key
    request: JobRequest
    job: JobState | None


@dataclass(frozen=True, slots=True)
class RegistrationJobs:
    """The jobs of all registrations of a step, and their state."""

    tasks: tuple[Task, ...]
    tasks_for: Mapping[str, tuple[Task, ...]]  # the tasks of each registration, in the order of the computation
    arrived: Mapping[str, JobState]  # the finished job `register` of each registration that has one
    failed: Mapping[str, str]  # registration → why it cannot be computed

    @property
    def due(self) -> list[Task]:
        """The tasks that can be enqueued now."""
        return [task for task in self.tasks if task.job is None]


def registration_jobs(
    state: RunState, step: Step, waited: Iterable[str], outlines: JobRequest, root: str
) -> RegistrationJobs:
    """Return every job of every registration of a step, as far as the results so far allow to plan them.

    Args:
        state: the run's state.
        step: the registration step.
        waited: the names of the registrations that the step waits for.
        outlines: the job that detects the spheres; the arguments of all other jobs derive from its arguments.
        root: the name of that job; jobs that use other images have another root in their names.
    """
    wanted = step.params_as(RegistrationParams)
    plan = _Plan(state, step.id, wanted, outlines, root)
    urgent = set(waited)
    arrived: dict[str, JobState] = {}
    for name, (source, size) in sorted(wanted.registrations.items(), key=lambda item: item[0] not in urgent):
        priority = WAITED if name in urgent else REDUCED if size else LATER
        job = plan.registration(name, source, size, priority)
        if job is not None:
            arrived[name] = job
    tasks_for = {name: tuple(plan.tasks[key] for key in keys) for name, keys in plan.tasks_for.items()}
    return RegistrationJobs(tuple(plan.tasks.values()), tasks_for, arrived, plan.failed)


class _Images(JobRecord):
    """The images of a job's arguments."""

    images: tuple[PosedPhotograph, ...]


@dataclass(frozen=True, slots=True)
class _Model:
    """Files with camera poses and, of structure from motion, the tracks."""

    model: str
    tracks: str | None = None

    def fields(self) -> dict[str, str]:
        """Return the files as arguments of the jobs that use them."""
        return {"model": self.model} if self.tracks is None else {"model": self.model, "tracks": self.tracks}


@dataclass
class _Plan:
    """Plans the jobs from the images to each registration, as far as the results they need are there."""

    state: RunState
    step: str
    wanted: RegistrationParams
    outlines: JobRequest
    root: str
    tasks: dict[tuple[str, str], Task] = field(default_factory=dict[tuple[str, str], Task])
    tasks_for: dict[str, list[tuple[str, str]]] = field(default_factory=dict[str, list[tuple[str, str]]])
    failed: dict[str, str] = field(default_factory=dict[str, str])
    jobs: Mapping[str, JobState] = field(default_factory=dict[str, JobState])
    _for: str = ""
    _priority: int = WAITED

    def __post_init__(self) -> None:
        self.jobs = jobs_of(self.state)

    def registration(self, name: str, source: str, size: str, priority: int) -> JobState | None:
        """Return the finished job `register` of a registration, or None; the jobs that it needs become tasks."""
        self._for, self._priority = name, priority
        if size and (reason := self._no_reduction(size)):
            self.failed[name] = reason
            return None
        return self._registered(source, size)

    def _no_reduction(self, size: str) -> str:
        """Return why a size does not reduce the photographs, or "": a protocol serves cameras of any resolution."""
        width, height = _pixels(size)
        camera = read_part(ImagesCamera, self.outlines.arguments, self.jobs).camera
        # Otherwise one side at least would be cropped at full scale.
        if width < camera.width and height < camera.height:
            return ""
        return f"{width} × {height} does not reduce photographs of {camera.width} × {camera.height} px"

    def _registered(self, source: str, size: str) -> JobState | None:
        search = self._arguments(size)
        shared = {key: value for key, value in search.items() if key not in _SEARCH_ONLY}
        if not posed(read_part(_Images, search).images):
            first = self._model(self._mapper(""), size, shared)  # spheres are searched where poses predict them
            if first is None:
                return None
            search |= {"model": first.model}
        detected = self._need("detect_spheres", "", size, search)
        if detected is None:
            return None
        markers = {**shared, "outlines": detected.artefacts[0].sha256, "poses": source}
        if source in QUICK:
            reported = _uncorrected(markers) if source == "robot" else {}
            return self._need("register", source, size, {**markers, **reported, "state_pose_errors": True})
        model = self._model(self._mapper(source), size, shared)
        if model is not None and source == "hybrid":
            # It starts from one reconstruction and adds the robot and the spheres.
            adjusted = self._need("hybrid", source, size, {**markers, **model.fields()})
            model = None if adjusted is None else _Model(adjusted.artefacts[0].sha256)
        return None if model is None else self._need("register", source, size, {**markers, **model.fields()})

    def _mapper(self, source: str) -> str:
        """Return the mapper of a source; one without uses that of another wanted source."""
        wanted = [mapper for other, mapper in _MAPPERS.items() if other in self.wanted.poses]
        return _MAPPERS.get(source) or next(iter(wanted), "incremental")

    def _model(self, mapper: str, size: str, shared: Mapping[str, Any]) -> _Model | None:
        """Return poses and tracks of structure from motion; None until they are computed."""
        known = next((source for source in reversed(QUICK) if source in self.wanted.poses), None)
        prior = None
        if known is not None:
            # Registered robot poses share one frame over both stations: they say which images overlap.
            registered = self._registered(known, "")
            if registered is None:
                return None
            prior = Reference(registered.job, "result/T_scan_camera")
        pieces = self._pieces(size, shared, prior)
        if pieces is None:
            return None
        arguments = {
            **shared,
            **pieces,
            "mappers": [mapper],
            "effort": self.wanted.structure_from_motion.effort.plain(),
            "prior": None if prior is None else prior.record(),
        }
        made = self._need("structure_from_motion", mapper, size, arguments)
        if made is None:
            return None
        refs = {ref.original_name: ref.sha256 for ref in made.artefacts}
        return _Model(refs[f"{mapper}.json"], refs[f"{mapper}_tracks.npz"])

    def _pieces(self, size: str, shared: Mapping[str, Any], prior: Reference | None) -> dict[str, Any] | None:
        """Return features and matches as arguments, and those computed while images arrived; None until all exist."""
        effort = self.wanted.structure_from_motion.effort
        common = {**_copied(shared, "camera"), "effort": effort.plain(), **_copied(shared, *_REDUCED)}
        images = read_part(_Images, shared).images
        camera = read_part(ImagesCamera, shared, self.jobs).camera
        early = _EarlyJobs() if size else _found_early(self.state, self.jobs, camera, effort)
        jobs: list[JobState | None] = [
            early.features[image.sha256] for image in images if image.sha256 in early.features
        ]
        rest = [image for image in images if image.sha256 not in early.features]
        for some in _chunks(rest, _IMAGES_A_JOB):
            what = arguments_name({"images": [image.sha256 for image in some]})
            files = [ImageFile(viewpoint=image.viewpoint, sha256=image.sha256).plain() for image in some]
            jobs.append(self._need("features", what, size, {**common, "images": files}))
        made = [job for job in jobs if job is not None and job.status == "finished"]
        if len(made) < len(jobs):
            return None
        by_image: dict[str, str] = {}
        for job in made:
            these = zip(read_part(ImagesToMatch, job.arguments).images, job.artefacts, strict=True)
            by_image |= {image.sha256: ref.sha256 for image, ref in these}
        features = {image.viewpoint: by_image[image.sha256] for image in images}
        matched: list[JobState | None] = [*early.matching(features)]
        done = {pair for job in early.matching(features) for pair in read_part(PairsToMatch, job.arguments).pairs}
        known = {} if prior is None else {name: np.array(T) for name, T in resolve(prior.record(), self.jobs).items()}
        options = SfmOptions(**effort.set_fields())
        left = [pair for pair in pairs_of(features, known or None, options) if pair not in done]
        for pairs in _chunks(left, _PAIRS_A_JOB):
            mine = {name: features[name] for pair in pairs for name in pair}
            listed = [list(pair) for pair in pairs]
            what = arguments_name({"pairs": listed})
            matched.append(self._need("match", what, size, {**common, "features": mine, "pairs": listed}))
        finished = [job for job in matched if job is not None and job.status == "finished"]
        if len(finished) < len(matched):
            return None
        return {"features": features, "matches": [job.artefacts[0].sha256 for job in finished]}

    def _arguments(self, size: str) -> dict[str, Any]:
        """Return the arguments of the search for outlines at a size; the other jobs share most of them."""
        arguments = dict(self.outlines.arguments)
        arguments.pop("model", None)  # present where the search itself needed poses from structure from motion
        if not size:
            return arguments
        width, height = _pixels(size)
        arguments.pop("intrinsics_covariance", None)  # it belongs to the full size
        arguments.pop("developed", None)  # so do the developed raw files
        return arguments | {"reduced_to": [width, height]}

    def _need(self, kind: str, what: str, size: str, arguments: Mapping[str, Any]) -> JobState | None:
        """Return the finished job for this work; None until it has finished, or if it has failed."""
        name = "-".join(part for part in (what, size, self.root) if part)
        job = newest_job(self.state, self.step, kind, name)
        if job is not None and job.status == "failed":
            if job.attempt == self.state.steps[self.step].attempt:
                self.failed.setdefault(self._for, f"{kind.replace('_', ' ')}: {job.message}")
            else:
                job = None  # a repeated step computes it again
        mine = self.tasks_for.setdefault(self._for, [])
        if (kind, name) not in mine:
            mine.append((kind, name))
        request = JobRequest(kind, arguments, self._priority, job_kinds()[kind].version)
        self.tasks.setdefault((kind, name), Task(name, request, job))
        return job if job is not None and job.status == "finished" else None


def _uncorrected(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments that take the arms' poses as they are reported."""
    without: dict[str, Any] = {"arm_correction": None}
    if arguments.get("further_arms"):
        without["further_arms"] = [{**arm, **without} for arm in arguments["further_arms"]]
    return without


def _copied(arguments: Mapping[str, Any], *names: str) -> dict[str, Any]:
    """Copy those of the recorded arguments that exist; references are not resolved."""
    return {name: arguments[name] for name in names if name in arguments}


def _pixels(size: str) -> tuple[int, int]:
    """Return width and height of 1920x1080."""
    width, _, height = size.partition("x")
    return int(width), int(height)


@dataclass
class _EarlyJobs:
    """Early jobs of one camera and effort; some may not have finished."""

    features: dict[str, JobState] = field(default_factory=dict[str, JobState])  # by the image's hash
    matches: list[JobState] = field(default_factory=list[JobState])

    def matching(self, features: Mapping[str, str]) -> list[JobState]:
        """Return the jobs that matched exactly these features; `features` maps viewpoints to hashes of files."""
        return [
            job for job in self.matches if read_part(PairsToMatch, job.arguments).features.items() <= features.items()
        ]


def _found_early(state: RunState, jobs: Jobs, camera: Camera, effort: SfmEffort) -> _EarlyJobs:
    """Return the jobs that computed features and matches with this camera and effort while the images arrived."""
    early = _EarlyJobs()
    for step in state.steps.values():
        for job in step.jobs.values():
            if job.priority != EARLY or job.kind not in ("features", "match"):
                continue
            if job.status == "failed":
                continue
            shared = read_part(FrontEndArguments, job.arguments, jobs)
            if shared.effort.plain() != effort.plain() or shared.camera.plain() != camera.plain():
                continue
            if job.kind == "features":
                early.features[read_part(ImagesToMatch, job.arguments).images[0].sha256] = job
            else:
                early.matches.append(job)
    return early


def _chunks(items: Iterable[T], size: int) -> list[list[T]]:
    """Return the items in order, in lists of at most `size`."""
    listed = list(items)
    return [listed[i : i + size] for i in range(0, len(listed), size)]


def recorded_registration_jobs(protocol: Protocol, state: RunState, step: Step) -> RegistrationJobs | None:
    """Return the jobs of a step's registrations according to the record; None for a step that has not started them.

    Also None in runs of old versions, in which a registration waited for all of its sources.
    """
    now = state.steps[step.id]
    if step.gives != "registrations" or now.skipped or all(note.note != PLANNED for note in now.notes):
        return None
    begun = [
        j for j in now.jobs.values() if j.kind == detect_spheres.KIND.name and not set(_REDUCED) & set(j.arguments)
    ]
    if not begun:
        return None
    newest = max(begun, key=lambda job: job.enqueued_seq)
    outlines = JobRequest(newest.kind, newest.arguments, newest.priority, 2)
    return registration_jobs(state, step, decisive(protocol, step), outlines, name_of(newest))


def name_of(job: JobState) -> str:
    """Return the part of a job's key that distinguishes it from other jobs of its kind."""
    return job.idempotency_key.split("/")[3]


# --- further cameras -----------------------------------------------------------------------------------------------

_SPHERES = ("spheres_m", "sphere_covariance_m2", "radius_m", "colour")  # arguments of the search for outlines

_OF_REGISTRATION = ("T_world_scan", "covariance", "T_scan_camera", "camera", "outlines")  # parts of its answer
_OF_LENS = ("intrinsics_covariance",)


def locate_further_cameras(
    context: StepContext,
    images_of: Iterable[str],
    outlines: JobRequest,
    registered: Mapping[str, JobState],
    *,
    on_raw: bool,
) -> Mapping[str, JobResult]:
    """Locate each further camera that exposed in these capture steps; return the worker's answers by camera name.

    Args:
        context: the registration step's surroundings: devices, evidence, clock.
        images_of: the capture steps' ids.
        outlines: the search for spheres in the first camera's images, which has the arguments on the spheres.
        registered: the finished job of each registration of those images.
        on_raw: true to measure in developed raw files, for a camera that wrote one with every image.
    """
    exposures = sorted(_exposures(context, images_of), key=lambda exposure: exposure[1].device)
    requests = {
        device: _of_camera(context, [*group], outlines, registered, on_raw=on_raw)
        for device, group in groupby(exposures, lambda exposure: exposure[1].device)
    }
    return dict(zip(requests, context.evidence.run_jobs(*requests.values()), strict=True)) if requests else {}


def _exposures(context: StepContext, images_of: Iterable[str]) -> list[tuple[str, FurtherExposure]]:
    """Return (viewpoint, exposure) of every usable view."""
    return [
        (capture.viewpoint, exposure)
        for step in images_of
        for capture in context.evidence.captures(step)
        if isinstance(capture, ViewpointCaptured) and all(capture.verdicts.values())
        for exposure in capture.further
    ]


def _of_camera(
    context: StepContext,
    exposures: Sequence[tuple[str, FurtherExposure]],
    outlines: JobRequest,
    registered: Mapping[str, JobState],
    *,
    on_raw: bool,
) -> JobRequest:
    """Return the job for one camera; its newest calibration counts."""
    last = exposures[-1][1]
    recorded = outlines.arguments
    arguments: dict[str, object] = {
        "device": last.device,
        "mounted": last.mounted,
        "images": [
            ImageFile(viewpoint=viewpoint, sha256=exposure.artefacts[0].sha256).plain()
            for viewpoint, exposure in exposures
        ],
        "calibration": last.calibration.sha256,
        **{name: recorded[name] for name in _SPHERES if name in recorded},
    }
    raws = [exposure_of(viewpoint, exposure.artefacts) for viewpoint, exposure in exposures]
    if on_raw and None not in raws:
        arguments["developed"] = developed(context, [raw for raw in raws if raw is not None])
    if last.mounted == "rigid":
        job = registered[most_preferred(registered)]
        first = {name: Reference(job.job, f"result/{name}").record() for name in _OF_REGISTRATION}
        arguments["first"] = first | {name: recorded[name] for name in _OF_LENS if name in recorded}
    return JobRequest(further_camera.KIND.name, arguments, version=further_camera.KIND.version)
