"""The images of a registration where it located them, for a second mesh that is registered with the same cameras."""

from __future__ import annotations

from service.core.jobs.references import Jobs
from service.core.run.state import JobState
from service.jobs.kind import read_part
from service.jobs.records import Mounting, PosedPhotograph, has_poses
from service.jobs.registration import register


class _Posed(Mounting):
    """What a registration was told of its images' poses."""

    images: tuple[PosedPhotograph, ...]
    poses: str


def located_images(registered: JobState, jobs: Jobs) -> tuple[PosedPhotograph, ...] | None:
    """The images with the poses that the spheres of the first mesh gave them, in its frame.

    None if the poses were known before: by an arm, from the capture by hand, or by structure from motion. Otherwise
    each mesh would locate the images by its own spheres, in its own frame, and the two could not be compared.

    Args:
        registered: the finished job `register` of the first mesh.
        jobs: of the run, for references.
    """
    arguments = read_part(_Posed, registered.arguments, jobs)
    if arguments.poses != "spheres" or has_poses(arguments, arguments.images):
        return None
    found = register.KIND.read_answer(registered.result).T_scan_camera
    return tuple(
        image.model_copy(update={"T_scene_camera": found[image.viewpoint]})
        for image in arguments.images
        if image.viewpoint in found
    )
