"""Job kind `further_camera`: the pose of a further camera, in the room or on the mount, from the spheres it saw."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from service.jobs.kind import Demand, JobKind, JobRecord
from service.jobs.records import Camera, Hash, ImageFile, Matrix, ParameterCovariance, Point
from service.machine.resources import IMAGE_MB, processes_for


class FirstCamera(JobRecord):
    """The registration of the first camera's images.

    Attributes:
        T_world_scan: the registration, whose covariance is (6, 6).
        T_scan_camera: the camera's pose by viewpoint.
        camera: its intrinsics.
        outlines: the file with the outlines in its images.
        intrinsics_covariance: the covariance of its intrinsics; None: not known.
    """

    T_world_scan: Matrix
    covariance: Matrix
    T_scan_camera: dict[str, Matrix]
    camera: Camera
    outlines: Hash
    intrinsics_covariance: ParameterCovariance | None = None


class Arguments(JobRecord):
    """The images of a further camera, and the spheres.

    Attributes:
        device: name of the camera in rig.yaml.
        mounted: fixed in the room, or rigid beside the first camera.
        images: the images with the viewpoints at which they were taken.
        calibration: file with the camera's intrinsics, as `calibrate intrinsics` writes it.
        first: the first camera's registration; only for a rigid one.
        spheres_m: the spheres' centres in the scan.
        sphere_covariance_m2: (3, 3) of each centre.
        radius_m: the spheres' radius.
        colour: the spheres' colour, if the protocol gives it.
        developed: file of the job `develop` by viewpoint, in which the outlines are measured; None: in the images.
    """

    device: str
    mounted: Literal["fixed", "rigid"]
    images: tuple[ImageFile, ...]
    calibration: Hash
    first: FirstCamera | None = None
    spheres_m: tuple[Point, ...]
    sphere_covariance_m2: tuple[Matrix, ...]
    radius_m: float
    colour: str | None = None
    developed: dict[str, Hash] | None = None


class Answer(JobRecord):
    """The pose of a further camera in its outer frame: that of the scan if it is fixed, else the first camera's.

    Attributes:
        device: name of the camera in rig.yaml.
        mounted: fixed in the room, or rigid beside the first camera.
        camera: its intrinsics.
        calibration: the file with the intrinsics.
        outlines: the file with the outlines of its images, by viewpoint.
        measured_on: the kind of images in which these were measured: its JPEGs or its developed raw files.
        T_outer_camera: the pose; None if its images do not determine it; `why` gives the reason.
        covariance: the pose's covariance (6, 6), m and rad.
        views: the views on which it rests.
        excluded: the images left out, with the reason.
        consistency_mm: the rms distance of the views' own poses from it.
        consistency_mrad: the rms angle between them and it.
        chi2_reduced: the reduced χ² of the views against the noise of their outlines.
    """

    device: str
    mounted: Literal["fixed", "rigid"]
    camera: Camera
    calibration: Hash = ""
    outlines: Hash = ""
    measured_on: Literal["jpeg", "raw"] = "jpeg"
    T_outer_camera: Matrix | None = None
    covariance: Matrix | None = None
    why: str = ""
    views: tuple[str, ...] = ()
    excluded: dict[str, str] = Field(default_factory=dict[str, str])
    consistency_mm: float | None = None
    consistency_mrad: float | None = None
    chi2_reduced: float | None = None


KIND = JobKind(
    name="further_camera",
    arguments=Arguments,
    answer=Answer,
    compute="service.worker.further_camera:further_camera",
    words="further camera",
    version=3,  # reports that light displaces single spheres
    order=62,
    demand=lambda arguments: Demand(
        memory_mb=600 + IMAGE_MB * processes_for(len(arguments.images), IMAGE_MB),
        limit_s=3600 + 120 * len(arguments.images),
    ),
)
