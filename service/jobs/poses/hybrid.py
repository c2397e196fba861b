"""Job kind `hybrid`: bundle adjustment of a model's tracks, the robot's poses and the registration spheres."""

from __future__ import annotations

from service.jobs.kind import JobKind, NoAnswer
from service.jobs.records import Hash
from service.jobs.registration.detect_spheres import SceneArguments


class Arguments(SceneArguments):
    """Outlines, and the model with its tracks from which the adjustment starts."""

    outlines: Hash
    poses: str = "hybrid"
    model: Hash
    tracks: Hash


KIND = JobKind(
    name="hybrid",
    arguments=Arguments,
    answer=NoAnswer,
    compute="service.worker.poses.models:hybrid",
    words="hybrid camera poses",
    order=51,
)
