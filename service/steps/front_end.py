"""Features and matches of images: computed while the images arrive, and completed by the registration.

Both depend only on the images, so the result does not depend on when or in which process they were computed. The
pairs to match early follow from the planned viewpoints.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from service.computations import calibrate, features, match
from service.computations.features import FrontEndArguments, SfmEffort
from service.computations.kind import read_part
from service.computations.records import Camera, ImageFile
from service.compute.sfm.options import SfmOptions, pairs_of
from service.core.errors import ConfigurationError
from service.core.geometry import Transform
from service.core.jobs import Jobs, job_key
from service.core.protocol.models import Protocol, Step
from service.core.records.events import ViewpointCaptured
from service.core.run.state import EARLY, JobState, RunState
from service.steps.context import JobRequest, StepContext
from service.steps.inputs import EarlierAnswer, earlier_answer
from service.steps.registration_sources import WantedRegistrations
from service.steps.viewpoints import Viewpoint
from service.store.records import NewJob

T = TypeVar("T")
_SOURCES_OF_IMAGES = frozenset({"colmap", "glomap", "hybrid", "triangulated"})
IMAGES_A_JOB, PAIRS_A_JOB = 8, 100  # in the jobs that complete them


@dataclass
class EarlyFeatures:
    """Enqueues the features of every image as soon as it is captured. The capture never waits for them."""

    context: StepContext
    camera: EarlierAnswer[calibrate.Answer]
    effort: SfmEffort
    neighbours: Mapping[str, Sequence[str]]  # by viewpoint, as planned
    asked: set[str] = field(default_factory=set[str])

    @classmethod
    def begin(cls, context: StepContext, plan: Sequence[Viewpoint]) -> EarlyFeatures | None:
        """Prepare early features; None if no registration matches these images, or without a calibration."""
        registration = _registration_of(context.protocol, context.step.id)
        if registration is None:
            return None
        wanted = WantedRegistrations.of(registration.params)
        try:
            camera = earlier_answer(context, wanted.calibration, calibrate.KIND)
        except ConfigurationError:
            return None
        effort = wanted.structure_from_motion
        options = SfmOptions(**effort.set_fields())
        nominal = context.devices.nominal_T_flange_camera()
        neighbours: dict[str, list[str]] = {}
        for station in dict.fromkeys(v.station for v in plan):
            poses = {v.name: v.T_base_camera for v in plan if v.station == station}
            poses |= _taken(context, wanted, station, nominal)
            for a, b in pairs_of(poses, poses, options):
                neighbours.setdefault(a, []).append(b)
                neighbours.setdefault(b, []).append(a)
        begun = cls(context, camera, effort, neighbours)
        jobs = context.evidence.jobs(context.step.id)
        begun.asked = {_image_of(job).sha256 for job in jobs if job.kind == "features"}
        return begun

    def look(self) -> None:
        """Enqueue the features of every new image. Returns at once."""
        for capture in self.context.evidence.captures(self.context.step.id):
            sha256 = capture.artefacts[0].sha256
            if sha256 in self.asked or not all(capture.verdicts.values()):
                continue
            self.asked.add(sha256)
            arguments = features.Arguments(
                camera=self.camera.answer.camera,
                effort=self.effort,
                images=(ImageFile(viewpoint=capture.viewpoint, sha256=sha256),),
                match_with=tuple(sorted(self.neighbours.get(capture.viewpoint, ()))),
            )
            references = {"camera": self.camera.reference("camera")}
            self.context.evidence.enqueue(JobRequest.of(features.KIND, arguments, references, EARLY), sha256)


def _registration_of(protocol: Protocol, capture: str) -> Step | None:
    """Return the step that will register the images of a capture by their features."""
    for step in protocol.steps:
        if step.gives == "registrations":
            wanted = WantedRegistrations.of(step.params)
            if capture in wanted.captures and _SOURCES_OF_IMAGES.intersection(wanted.poses):
                return step
    return None


def _taken(
    context: StepContext, wanted: WantedRegistrations, station: str, nominal: Transform
) -> dict[str, Transform]:
    """Return the approximate T_base_camera of the images of earlier steps at a station, by viewpoint."""
    earlier = [step for step in wanted.captures if step != context.step.id]
    captures = [c for step in earlier for c in context.evidence.captures(step) if isinstance(c, ViewpointCaptured)]
    return {c.viewpoint: np.array(c.T_base_flange) @ nominal for c in captures if c.station == station}


def early_matches(protocol: Protocol, state: RunState) -> list[NewJob]:
    """Return the matching jobs that are due: of each image with its planned neighbours, if both have features."""
    found: dict[str, tuple[str, JobState]] = {}
    pairs_done: set[tuple[str, str]] = set()
    matched: set[str] = set()
    for step in protocol.steps:
        for job in state.steps[step.id].jobs.values():
            if job.kind == "features" and job.priority == EARLY and job.status == "finished":
                found[_image_of(job).viewpoint] = (step.id, job)
            elif job.kind == "match" and job.priority == EARLY:
                pairs_done |= set(read_part(match.PairsToMatch, job.arguments).pairs)
                matched.add(job.idempotency_key.split("/")[3])
    jobs: list[NewJob] = []
    for name, (step_id, job) in found.items():
        sha256 = job.artefacts[0].sha256
        if sha256 in matched:
            continue
        there = [other for other in _asked_of(job).match_with if other in found]
        pairs = sorted({(min(name, other), max(name, other)) for other in there} - pairs_done)
        pairs_done |= set(pairs)
        if not pairs:
            continue
        named = {n: found[n][1].artefacts[0].sha256 for pair in pairs for n in pair}
        shared = {key: job.arguments[key] for key in ("camera", "effort")}  # references stay references
        arguments = {**shared, "features": named, "pairs": [list(pair) for pair in pairs]}
        key = job_key(state, step_id, "match", sha256)
        attempt = state.steps[step_id].attempt
        jobs.append(
            NewJob(match.KIND.name, step_id, attempt, key, arguments, priority=EARLY, version=match.KIND.version)
        )
    return jobs


# --- use by the registration ---------------------------------------------------------------------------------------


@dataclass
class EarlyJobs:
    """Early jobs of one camera and effort; some may not have finished."""

    features: dict[str, JobState] = field(default_factory=dict[str, JobState])  # by the image's hash
    matches: list[JobState] = field(default_factory=list[JobState])

    def matching(self, features: Mapping[str, str]) -> list[JobState]:
        """Return the jobs that matched exactly these features; `features` maps viewpoints to hashes of files."""
        return [
            job
            for job in self.matches
            if read_part(match.PairsToMatch, job.arguments).features.items() <= features.items()
        ]


def found_early(state: RunState, jobs: Jobs, camera: Camera, effort: SfmEffort) -> EarlyJobs:
    """Return the jobs that computed features and matches with this camera and effort while the images arrived."""
    early = EarlyJobs()
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
                early.features[_image_of(job).sha256] = job
            else:
                early.matches.append(job)
    return early


def _asked_of(job: JobState) -> features.ImagesToMatch:
    return read_part(features.ImagesToMatch, job.arguments)


def _image_of(job: JobState) -> ImageFile:
    """Return the image of an early job on features, which has only one."""
    return _asked_of(job).images[0]


def chunks(items: Iterable[T], size: int) -> list[list[T]]:
    """Return the items in order, in lists of at most `size`."""
    listed = list(items)
    return [listed[i : i + size] for i in range(0, len(listed), size)]
