"""Job kind `detect_spheres`: outlines of every sphere in every image, as one file that all registrations share."""

from __future__ import annotations

from typing import Literal

from service.jobs.kind import Demand, JobKind, NoAnswer
from service.jobs.records import Hash, ImagesCamera, Matrix, Mounting, ParameterCovariance, Point, PosedPhotograph
from service.machine.resources import IMAGE_MB, processes_for

DetectorName = Literal["classical", "paper", "grounded", "vote"]


class SceneArguments(ImagesCamera, Mounting):
    """Arguments that all jobs of a registration share.

    Attributes:
        images: the images of the captures, including control captures.
        intrinsics_covariance: (8, 8) of fx, fy, cx, cy, k1, k2, p1, p2, or a covariance with its parameters' names.
        spheres_m: the spheres' centres in the scan.
        sphere_covariance_m2: (3, 3) of each centre.
        radius_m: the spheres' radius.
    """

    images: tuple[PosedPhotograph, ...]
    intrinsics_covariance: Matrix | ParameterCovariance | None = None
    spheres_m: tuple[Point, ...]
    sphere_covariance_m2: tuple[Matrix, ...]
    radius_m: float


class Arguments(SceneArguments):
    """The way to search outlines; `model` holds the poses if neither a robot nor spheres provide them.

    `developed` holds the file of the job `develop` by viewpoint: outlines found in the photographs are then measured
    in these; None: in the photographs.

    The detectors `grounded` and `vote` need the weights of their networks on the worker's machine; the job's file
    `weights.json` has the hashes of these.
    """

    model: Hash | None = None
    colour: str | None = None
    detector: DetectorName = "classical"
    developed: dict[str, Hash] | None = None


KIND = JobKind(
    name="detect_spheres",
    arguments=Arguments,
    answer=NoAnswer,
    compute="service.worker.outlines:detect_spheres",
    words="spheres in images",
    version=3,
    order=60,
    demand=lambda arguments: Demand(
        memory_mb=600 + IMAGE_MB * processes_for(len(arguments.images), IMAGE_MB),
        limit_s=3600 + 120 * len(arguments.images),
    ),
)
