"""The jobs that lead from the images to each registration of a step, planned from the record.

Nothing is enqueued here. The step enqueues the jobs that are due; once it has ended, the worker does so after each
job, so that results still arrive when no process drives the run any more.

The arguments of every job derive from those of the search for spheres (service/steps/registration.py): its recorded
arguments are read with their references resolved, and written again with the references in their places.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, TypeVar

import numpy as np

from service.computations.further_cameras import FURTHER_CAMERA, FirstCamera, FurtherCameraArguments
from service.computations.image_poses import (
    FEATURES,
    HYBRID,
    MATCH,
    STRUCTURE_FROM_MOTION,
    FeaturesArguments,
    FrontEndArguments,
    HybridArguments,
    ImagesToMatch,
    MatchArguments,
    PairsToMatch,
    StructureFromMotionArguments,
)
from service.computations.kind import JobKind, JobRecord, read_part
from service.computations.records import ImageFile, ImagesCamera, Matrix
from service.computations.registration import (
    DETECT_SPHERES,
    REGISTER,
    DetectSpheresArguments,
    RegisterArguments,
    SceneArguments,
)
from service.compute.sfm.options import Mapper, SfmOptions, pairs_of
from service.core.jobs import Each, Jobs, Reference, arguments_name, jobs_of, newest_job, references_in
from service.core.protocol import Protocol, Step
from service.core.records.run_events import FurtherExposure, ViewpointCaptured
from service.core.run.state import EARLY, LATER, REDUCED, WAITED, JobState, RunState
from service.steps.context import JobRequest, JobResult, StepContext
from service.steps.registration import (
    PLANNED,
    QUICK,
    References,
    RegistrationParams,
    decisive,
    developed,
    exposure_of,
    most_preferred,
    posed,
)

T = TypeVar("T")
A = TypeVar("A", bound=JobRecord)
_REDUCED = ("reduced_to", "full_camera")  # arguments of jobs on reduced images; the second one in old runs only
_FULL_SIZE_ONLY = ("intrinsics_covariance", "developed")  # arguments that belong to the full size
_IMAGES_A_JOB, _PAIRS_A_JOB = 8, 100  # in the jobs that complete features and matches
_MAPPERS: Mapping[str, Mapper] = {"colmap": "incremental", "glomap": "global", "triangulated": "triangulated"}


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


def recorded_registration_jobs(protocol: Protocol, state: RunState, step: Step) -> RegistrationJobs | None:
    """Return the jobs of a step's registrations according to the record; None for a step that has not started them.

    Also None in runs of old versions, in which a registration waited for all of its sources.
    """
    now = state.steps[step.id]
    if step.gives != "registrations" or now.skipped or all(note.note != PLANNED for note in now.notes):
        return None
    begun = [j for j in now.jobs.values() if j.kind == DETECT_SPHERES.name and not set(_REDUCED) & set(j.arguments)]
    if not begun:
        return None
    newest = max(begun, key=lambda job: job.enqueued_seq)
    search = JobRequest(newest.kind, newest.arguments, DETECT_SPHERES.version, newest.priority)
    return registration_jobs(state, step, decisive(protocol, step), search, name_of(newest))


def name_of(job: JobState) -> str:
    """Return the part of a job's key that distinguishes it from other jobs of its kind."""
    return job.idempotency_key.split("/")[3]


def registration_jobs(
    state: RunState, step: Step, waited: Iterable[str], search: JobRequest, root: str
) -> RegistrationJobs:
    """Return every job of every registration of a step, as far as the results so far allow to plan them.

    Args:
        state: the run's state.
        step: the registration step.
        waited: the names of the registrations that the step waits for.
        search: the job that detects the spheres; the arguments of all other jobs derive from its arguments.
        root: the name of that job; jobs that use other images have another root in their names.
    """
    params, jobs = step.params_as(RegistrationParams), jobs_of(state)
    arguments = DETECT_SPHERES.read_arguments(search.arguments, jobs)
    plan = _Plan(state, jobs, step.id, params, arguments, dict(references_in(search.arguments)), root)
    urgent = set(waited)
    arrived: dict[str, JobState] = {}
    for name, (source, size) in sorted(params.registrations.items(), key=lambda item: item[0] not in urgent):
        priority = WAITED if name in urgent else REDUCED if size else LATER
        job = plan.registration(name, source, size, priority)
        if job is not None:
            arrived[name] = job
    tasks_for = {name: tuple(plan.tasks[key] for key in keys) for name, keys in plan.tasks_for.items()}
    return RegistrationJobs(tuple(plan.tasks.values()), tasks_for, arrived, plan.failed)


@dataclass
class _Plan:
    """Plans the jobs from the images to each registration, as far as the results they need are there."""

    state: RunState
    jobs: Jobs
    step: str
    params: RegistrationParams
    search: DetectSpheresArguments
    references: Mapping[str, Reference | Each]  # those of the search, by field
    root: str
    tasks: dict[tuple[str, str], Task] = field(default_factory=dict[tuple[str, str], Task])
    tasks_for: dict[str, list[tuple[str, str]]] = field(default_factory=dict[str, list[tuple[str, str]]])
    failed: dict[str, str] = field(default_factory=dict[str, str])
    _for: str = ""
    _priority: int = WAITED

    def registration(self, name: str, source: str, size: str, priority: int) -> JobState | None:
        """Return the finished job `register` of a registration, or None; the jobs that it needs become tasks."""
        self._for, self._priority = name, priority
        if size:  # a protocol serves cameras of any resolution
            width, height = _pixels(size)
            camera = self.search.camera
            # Otherwise one side at least would be cropped at full scale.
            if not (width < camera.width and height < camera.height):
                self.failed[name] = (
                    f"{width} × {height} does not reduce photographs of {camera.width} × {camera.height} px"
                )
                return None
        return self._registered(source, size)

    def _registered(self, source: str, size: str) -> JobState | None:
        search = self._search_at(size)
        scene = SceneArguments(
            **{name: value for name, value in search.set_fields().items() if name not in _OF_SEARCH}
        )
        if not posed(search.images):
            first = self._model(self._mapper(""), size, scene)  # spheres are searched where poses predict them
            if first is None:
                return None
            search = search.model_copy(update={"model": first[0]})
        detected = self._need(DETECT_SPHERES, "", size, search)
        if detected is None:
            return None
        outlines = RegisterArguments(**scene.set_fields(), outlines=detected.artefacts[0].sha256, poses=source)
        if source in QUICK:
            stated = outlines.model_copy(update={"state_pose_errors": True})
            arguments, references = self._uncorrected(stated) if source == "robot" else (stated, {})
            return self._need(REGISTER, source, size, arguments, references)
        model = self._model(self._mapper(source), size, scene)
        if model is None:
            return None
        poses, tracks = model
        if source == "hybrid":
            # It starts from one reconstruction and adds the robot and the spheres.
            start = HybridArguments(**outlines.set_fields(), model=poses, tracks=tracks)
            adjusted = self._need(HYBRID, source, size, start)
            if adjusted is None:
                return None
            known = {"model": adjusted.artefacts[0].sha256}
        else:
            known = {"model": poses, "tracks": tracks}
        return self._need(REGISTER, source, size, outlines.model_copy(update=known))

    def _search_at(self, size: str) -> DetectSpheresArguments:
        """Return the arguments of the search for outlines at a size; the other jobs share most of them."""
        fields = self.search.set_fields()
        fields.pop("model", None)  # present where the search itself needed poses from structure from motion
        if size:
            fields = {name: value for name, value in fields.items() if name not in _FULL_SIZE_ONLY}
            fields["reduced_to"] = _pixels(size)
        return DetectSpheresArguments(**fields)

    def _uncorrected(self, arguments: RegisterArguments) -> tuple[RegisterArguments, References]:
        """Return the arguments that take the arms' poses as they are reported, without references to corrections."""
        none: dict[str, Any] = {"arm_correction": None}
        if arguments.further_arms:
            none["further_arms"] = tuple(
                arm.model_copy(update={"arm_correction": None}) for arm in arguments.further_arms
            )
        corrections = [path for path in self.references if path.endswith("arm_correction")]
        return arguments.model_copy(update=none), dict.fromkeys(corrections)

    def _mapper(self, source: str) -> Mapper:
        """Return the mapper of a source; one without uses that of another wanted source."""
        names = [source, *(other for other in _MAPPERS if other in self.params.poses), "colmap"]
        return next(_MAPPERS[name] for name in names if name in _MAPPERS)

    def _model(self, mapper: Mapper, size: str, scene: SceneArguments) -> tuple[str, str] | None:
        """Return the files with poses and tracks of structure from motion; None until they are computed."""
        known = next((source for source in reversed(QUICK) if source in self.params.poses), None)
        prior, T_scan_camera = None, None
        if known is not None:
            # Registered robot poses share one frame over both stations: they say which images overlap.
            registered = self._registered(known, "")
            if registered is None:
                return None
            prior = Reference(registered.job, "result/T_scan_camera")
            T_scan_camera = read_part(_Located, registered.result).T_scan_camera
        pieces = self._pieces(size, scene, T_scan_camera)
        if pieces is None:
            return None
        found, matches = pieces
        arguments = StructureFromMotionArguments(
            **scene.set_fields(),
            mappers=(mapper,),
            effort=self.params.structure_from_motion.effort,
            prior=T_scan_camera,
            features=found,
            matches=matches,
        )
        made = self._need(STRUCTURE_FROM_MOTION, mapper, size, arguments, {"prior": prior})
        if made is None:
            return None
        refs = {ref.original_name: ref.sha256 for ref in made.artefacts}
        return refs[f"{mapper}.json"], refs[f"{mapper}_tracks.npz"]

    def _pieces(
        self, size: str, scene: SceneArguments, T_scan_camera: Mapping[str, Matrix] | None
    ) -> tuple[dict[str, str], tuple[str, ...]] | None:
        """Return the files of features by viewpoint, and of matches; None until all exist.

        Those that were computed while the images arrived are among them.
        """
        effort = self.params.structure_from_motion.effort
        camera = {name: value for name, value in scene.set_fields().items() if name in ImagesCamera.model_fields}
        shared = FrontEndArguments(**camera, effort=effort)
        early = _EarlyJobs() if size else _early_jobs(self.state, self.jobs, shared)
        jobs: list[JobState | None] = [
            early.features[image.sha256] for image in scene.images if image.sha256 in early.features
        ]
        rest = [image for image in scene.images if image.sha256 not in early.features]
        for some in _chunks(rest, _IMAGES_A_JOB):
            what = arguments_name({"images": [image.sha256 for image in some]})
            files = tuple(ImageFile(viewpoint=image.viewpoint, sha256=image.sha256) for image in some)
            jobs.append(self._need(FEATURES, what, size, FeaturesArguments(**shared.set_fields(), images=files)))
        made = [job for job in jobs if job is not None and job.status == "finished"]
        if len(made) < len(jobs):
            return None
        by_image: dict[str, str] = {}
        for job in made:
            these = zip(read_part(ImagesToMatch, job.arguments).images, job.artefacts, strict=True)
            by_image |= {image.sha256: ref.sha256 for image, ref in these}
        found = {image.viewpoint: by_image[image.sha256] for image in scene.images}
        matched: list[JobState | None] = [*early.matching(found)]
        done = {pair for job in early.matching(found) for pair in read_part(PairsToMatch, job.arguments).pairs}
        known = {name: np.array(T) for name, T in (T_scan_camera or {}).items()}
        left = [p for p in pairs_of(found, known or None, SfmOptions(**effort.set_fields())) if p not in done]
        for pairs in _chunks(left, _PAIRS_A_JOB):
            mine = {name: found[name] for pair in pairs for name in pair}
            arguments = MatchArguments(**shared.set_fields(), features=mine, pairs=tuple(pairs))
            matched.append(self._need(MATCH, arguments_name({"pairs": pairs}), size, arguments))
        finished = [job for job in matched if job is not None and job.status == "finished"]
        if len(finished) < len(matched):
            return None
        return found, tuple(job.artefacts[0].sha256 for job in finished)

    def _need(
        self, kind: JobKind[A, Any], what: str, size: str, arguments: A, references: References | None = None
    ) -> JobState | None:
        """Return the finished job for this work; None until it has finished, or if it has failed.

        The references of the search stand in the arguments that are its own; `references` are further ones.
        """
        name = "-".join(part for part in (what, size, self.root) if part)
        job = newest_job(self.state, self.step, kind.name, name)
        if job is not None and job.status == "failed":
            if job.attempt == self.state.steps[self.step].attempt:
                self.failed.setdefault(self._for, f"{kind.name.replace('_', ' ')}: {job.message}")
            else:
                job = None  # a repeated step computes it again
        mine = self.tasks_for.setdefault(self._for, [])
        if (kind.name, name) not in mine:
            mine.append((kind.name, name))
        if (kind.name, name) not in self.tasks:
            own = {p: ref for p, ref in self.references.items() if p.split("/")[0] in arguments.model_fields_set}
            request = JobRequest.of(kind, arguments, {**own, **(references or {})}, self._priority)
            self.tasks[kind.name, name] = Task(name, request, job)
        return job if job is not None and job.status == "finished" else None


_OF_SEARCH = DetectSpheresArguments.model_fields.keys() - SceneArguments.model_fields.keys()


class _Located(JobRecord):
    """The camera's pose by viewpoint, of a registration."""

    T_scan_camera: dict[str, Matrix]


def _pixels(size: str) -> tuple[int, int]:
    """Return width and height of 1920x1080."""
    width, _, height = size.partition("x")
    return int(width), int(height)


def _chunks(items: Iterable[T], size: int) -> list[list[T]]:
    """Return the items in order, in lists of at most `size`."""
    listed = list(items)
    return [listed[i : i + size] for i in range(0, len(listed), size)]


@dataclass
class _EarlyJobs:
    """Early jobs of one camera and effort; some may not have finished."""

    features: dict[str, JobState] = field(default_factory=dict[str, JobState])  # by the image's hash
    matches: list[JobState] = field(default_factory=list[JobState])

    def matching(self, found: Mapping[str, str]) -> list[JobState]:
        """Return the jobs that matched exactly these features; `found` maps viewpoints to hashes of files."""
        return [
            job for job in self.matches if read_part(PairsToMatch, job.arguments).features.items() <= found.items()
        ]


def _early_jobs(state: RunState, jobs: Jobs, wanted: FrontEndArguments) -> _EarlyJobs:
    """Return the jobs that computed features and matches with this camera and effort while the images arrived."""
    early = _EarlyJobs()
    for step in state.steps.values():
        for job in step.jobs.values():
            if job.priority != EARLY or job.kind not in ("features", "match") or job.status == "failed":
                continue
            shared = read_part(FrontEndArguments, job.arguments, jobs)
            if shared.effort.plain() != wanted.effort.plain() or shared.camera.plain() != wanted.camera.plain():
                continue
            if job.kind == "features":
                early.features[read_part(ImagesToMatch, job.arguments).images[0].sha256] = job
            else:
                early.matches.append(job)
    return early


# --- further cameras -----------------------------------------------------------------------------------------------

_SPHERES = ("spheres_m", "sphere_covariance_m2", "radius_m", "colour")  # arguments of the search that are theirs too
_OF_REGISTRATION = ("T_world_scan", "covariance", "T_scan_camera", "camera", "outlines")  # parts of its answer


def locate_further_cameras(
    context: StepContext, params: RegistrationParams, search: JobRequest, registered: Mapping[str, JobState]
) -> Mapping[str, JobResult]:
    """Locate each further camera that exposed in the capture steps; return the worker's answers by camera name.

    Args:
        context: the registration step's surroundings: devices, evidence, clock.
        params: the registration step's params. In developed raw files a camera is measured that wrote one with
            every image.
        search: the search for spheres in the first camera's images, which has the arguments on the spheres.
        registered: the finished job of each registration of those images.
    """
    exposures = [
        (capture.viewpoint, exposure)
        for step in params.images_of
        for capture in context.evidence.captures(step)
        if isinstance(capture, ViewpointCaptured) and all(capture.verdicts.values())
        for exposure in capture.further
    ]
    if not exposures:
        return {}
    exposures.sort(key=lambda exposure: exposure[1].device)
    own = DETECT_SPHERES.read_arguments(search.arguments, jobs_of(context.evidence.state())).set_fields()
    taken = dict(references_in(search.arguments))
    raw = params.measure_on == "raw"
    requests = {
        device: _of_camera(context, [*group], own, taken, registered, on_raw=raw)
        for device, group in groupby(exposures, lambda exposure: exposure[1].device)
    }
    return dict(zip(requests, context.evidence.run_jobs(*requests.values()), strict=True))


def _of_camera(
    context: StepContext,
    exposures: Sequence[tuple[str, FurtherExposure]],
    own: Mapping[str, Any],
    taken: Mapping[str, Reference | Each],
    registered: Mapping[str, JobState],
    *,
    on_raw: bool,
) -> JobRequest:
    """Return the job for one camera; its newest calibration counts.

    `own`, `taken`: the arguments of the search for spheres by field, and those that are references.
    """
    last = exposures[-1][1]
    references: References = {name: taken[name] for name in _SPHERES if name in taken}
    known = {name: own[name] for name in _SPHERES if name in own}
    raws = [exposure_of(viewpoint, exposure.artefacts) for viewpoint, exposure in exposures]
    if on_raw and None not in raws:
        known["developed"] = developed(context, [raw for raw in raws if raw is not None])
    if last.mounted == "rigid":
        job = registered[most_preferred(registered)]
        answer = REGISTER.read_answer(job.result)
        parts = {name: getattr(answer, name) for name in _OF_REGISTRATION}
        references |= {f"first/{name}": Reference(job.job, f"result/{name}") for name in _OF_REGISTRATION}
        if "intrinsics_covariance" in own:
            parts["intrinsics_covariance"] = own["intrinsics_covariance"]
            references["first/intrinsics_covariance"] = taken.get("intrinsics_covariance")
        known["first"] = FirstCamera(**parts)
    arguments = FurtherCameraArguments(
        device=last.device,
        mounted=last.mounted,
        images=tuple(
            ImageFile(viewpoint=viewpoint, sha256=exposure.artefacts[0].sha256) for viewpoint, exposure in exposures
        ),
        calibration=last.calibration.sha256,
        **known,
    )
    return JobRequest.of(FURTHER_CAMERA, arguments, references)
