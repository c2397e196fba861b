"""Features and matches of images: computed while the images arrive, and completed by the registration.

Both depend only on the images, so the result does not depend on when or in which process they were computed. The
pairs to match early follow from the planned viewpoints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from service.computations import calibrate, features, match
from service.computations.features import SfmEffort
from service.computations.kind import read_part
from service.computations.records import ImageFile
from service.compute.sfm.options import SfmOptions, pairs_of
from service.core.errors import ConfigurationError
from service.core.geometry import Transform
from service.core.jobs import job_key
from service.core.protocol.models import Protocol, Step
from service.core.records.events import ViewpointCaptured
from service.core.run.state import EARLY, JobState, RunState
from service.steps.context import EarlierAnswer, JobRequest, StepContext
from service.steps.registration import RegistrationParams
from service.steps.viewpoints import Viewpoint
from service.store.records import NewJob

_SOURCES_OF_IMAGES = frozenset({"colmap", "glomap", "hybrid", "triangulated"})


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
        wanted = registration.params_as(RegistrationParams)
        try:
            camera = context.earlier_answer(wanted.calibration, calibrate.KIND)
        except ConfigurationError:
            return None
        effort = wanted.structure_from_motion.effort
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
            wanted = step.params_as(RegistrationParams)
            if capture in wanted.captures and _SOURCES_OF_IMAGES.intersection(wanted.poses):
                return step
    return None


def _taken(
    context: StepContext, wanted: RegistrationParams, station: str, nominal: Transform
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


def _asked_of(job: JobState) -> features.ImagesToMatch:
    return read_part(features.ImagesToMatch, job.arguments)


def _image_of(job: JobState) -> ImageFile:
    """Return the image of an early job on features, which has only one."""
    return _asked_of(job).images[0]
