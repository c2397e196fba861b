"""The images of a registration where it located them, for a second mesh that is registered with the same cameras."""

from __future__ import annotations

from service.core.jobs.references import Jobs, Reference
from service.core.run.state import JobState
from service.jobs.kind import read_part
from service.jobs.records import Mounting, PosedPhotograph, has_poses
from service.jobs.registration import register
from service.steps.context import JobRequest


class _Posed(Mounting):
    """What a registration was told of its images' poses."""

    images: tuple[PosedPhotograph, ...]
    poses: str


def with_located_images(registered: JobState, jobs: Jobs) -> JobRequest:
    """The request of a registration, for another mesh, whose images stand where the spheres of the first placed them.

    As it was where their poses were known before: by an arm, from a capture by hand, or by structure from motion.
    Otherwise each mesh would locate the images by its own spheres, in its own frame, and the two could not be
    compared.

    Args:
        registered: the finished job `register` of the first mesh.
        jobs: of the run, for references.
    """
    recorded = dict(registered.arguments)
    known = read_part(_Posed, recorded, jobs)
    if known.poses == "spheres" and not has_poses(known, known.images):
        found = register.KIND.read_answer(registered.result).T_scan_camera
        recorded["images"] = [
            image.plain() | {"T_scene_camera": Reference(registered.job, f"result/T_scan_camera/{name}").record()}
            for image in known.images
            if (name := image.viewpoint) in found
        ]
    return JobRequest(register.KIND.name, recorded, version=register.KIND.version)
