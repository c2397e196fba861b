"""The answer to a job on a hand-held image: whether it counts, what all images give, and where to go next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from service.compute.hand_held import ImageReading
from service.compute.planning.hand_guidance import WantedView, level_frame, same_view
from service.core.geometry import Array, Transform, inverse
from service.jobs.capture import hand_view as job
from service.jobs.capture.hand_view import HeldArguments
from service.jobs.records import Matrix, Point, matrices, matrix
from service.worker.capture.hand_guide import HandGuide
from service.worker.capture.held_images import HandheldImage
from service.worker.capture.scene import CaptureScene
from service.worker.job import JobAnswer, JobContext, finite

_SAME_M, _SAME_RAD = 0.02, np.deg2rad(3.0)  # an image nearer than this to another one repeats it
_H = TypeVar("_H", bound=HeldArguments)


@dataclass(frozen=True, slots=True)
class NewImage:
    """What can be determined from the new image alone.

    Attributes:
        T_scene_camera: None if the pose cannot be determined.
        why: why it cannot be used; "" if it can.
        measures: numbers of this image.
        information: (6, 6) about the scan's pose.
        up: (3,) direction away from the table, frame of the scene.
        middle_m: (3,) of the scene.
        cells: board corners in each cell of the frame.
        reading: outlines and spheres, where the spheres have not been measured.
    """

    T_scene_camera: Transform | None
    why: str
    measures: Mapping[str, float]
    information: Array = field(repr=False)
    up: Array
    middle_m: Array
    cells: NDArray[np.int64] = field(repr=False)
    reading: ImageReading | None = field(default=None, repr=False)


def answer_to(
    context: JobContext[_H], found: NewImage, scene: CaptureScene, earlier: Sequence[HandheldImage]
) -> JobAnswer:
    """Judge the new image by those before it, and write its file."""
    arguments = context.arguments
    used = [view for view in earlier if view.used and view.T_scene_camera is not None]
    T = found.T_scene_camera
    why = arguments.image.settings or found.why or _repeats(T, used)
    new = HandheldImage(
        viewpoint=arguments.image.viewpoint,
        used=not why,
        T_scene_camera=T,
        T_scene_level=_level(found, earlier),
        information=found.information,
        seen=scene.seen_from(T),
        cells=found.cells,
        reading=found.reading,
        spheres_m=scene.spheres_m,
    )
    good = [*used, new] if new.used and T is not None else used
    guide = HandGuide(arguments, scene, new, earlier, good)
    measures = {**found.measures, **guide.totals()}
    ref = context.keep_json(new.plain(rough=arguments.rough), kind="hand_view", name=f"{new.viewpoint}.hand.json")
    answer = _result(guide, why)
    if arguments.rough:
        answer = _refined(answer, guide, used)
    return JobAnswer(finite(measures), (ref,), answer)


def _level(found: NewImage, earlier: Sequence[HandheldImage]) -> Transform | None:
    """T_scene_level of the first image that had one, else of this image if its pose is known."""
    level = next((view.T_scene_level for view in earlier if view.T_scene_level is not None), None)
    if level is None and found.T_scene_camera is not None:
        level = level_frame(found.middle_m, found.up, -found.T_scene_camera[:3, 1])
    return level


def _result(guide: HandGuide, why: str) -> job.Answer:
    new, done = guide.new, guide.done()
    next_words, target = guide.next_place()
    T, level = new.T_scene_camera, new.T_scene_level
    cells = [view.cells for view in guide.good if view.cells.size]
    return job.Answer(
        viewpoint=new.viewpoint,
        used=new.used,
        why=why,
        words=next_words,
        target=None if target is None else job.PlaceStatus(name=target.name, T_level_camera=_pose(target)),
        T_scene_camera=None if T is None else matrix(T),
        T_level_camera=None if T is None or level is None else matrix(inverse(level) @ T),
        places=tuple(
            job.PlaceStatus(name=place.name, T_level_camera=_pose(place), done=place.name in done)
            for place in guide.places()
        ),
        cells=np.sum(cells, axis=0).tolist() if new.cells.size else (),
    )


def _refined(answer: job.Answer, guide: HandGuide, used: Sequence[HandheldImage]) -> job.Answer:
    """Add the spheres and all camera poses, as estimated from the images, to the answer."""
    poses = {v.viewpoint: v.T_scene_camera for v in [*used, guide.new] if v.T_scene_camera is not None}
    spheres_m: tuple[Point, ...] = tuple((float(x), float(y), float(z)) for x, y, z in guide.scene.spheres_m)
    return answer.model_copy(update={"spheres_m": spheres_m, "T_scene_cameras": matrices(poses)})


def _pose(place: WantedView) -> Matrix:
    return matrix(place.T_level_camera)


def _repeats(T: Transform | None, used: Sequence[HandheldImage]) -> str:
    """Why an image adds nothing to the earlier ones, or ""."""
    if T is None:
        return ""
    same = [
        view.viewpoint
        for view in used
        if view.T_scene_camera is not None and same_view(view.T_scene_camera, T, _SAME_M, _SAME_RAD)
    ]
    return f"it repeats {same[0]}" if same else ""
