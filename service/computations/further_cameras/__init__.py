"""Job kinds of raw files and further cameras: `develop`, `further_view` of each image, `further_camera` of all."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from service.computations.kind import Demand, JobKind, JobRecord
from service.computations.records import Camera, Hash, ImageFile, Matrix, ParameterCovariance, Point
from service.compute.photography import Crop, DevelopParameters
from service.machine.resources import IMAGE_MB, processes_for


class DevelopArguments(JobRecord):
    """The raw file and the JPEG of one exposure, and how the raw file is developed."""

    viewpoint: str
    raw: Hash
    jpeg: Hash
    parameters: DevelopParameters


class DevelopAnswer(JobRecord):
    """The development of a raw file.

    Attributes:
        raw: SHA-256 of the raw file.
        parameters: the parameters that were asked for.
        white_balance: the gains that the camera recorded, of red, green, blue and second green.
        black_level: the black levels of the four photosites of the pattern.
        white_level: the largest of the sensor's values.
        area: width and height of the exposed area, px.
        crop: the picture's place in it.
        shift_px: the median shift of the picture against the JPEG, in x and y.
        largest_shift_px: the largest shift of a part of the picture.
        rawpy: the version of rawpy.
        libraw: the version of LibRaw.
    """

    raw: Hash
    parameters: DevelopParameters
    white_balance: tuple[float, ...]
    black_level: tuple[int, ...]
    white_level: int
    area: tuple[int, int]
    crop: Crop
    shift_px: tuple[float, float]
    largest_shift_px: float
    rawpy: str
    libraw: str


DEVELOP = JobKind(
    name="develop",
    arguments=DevelopArguments,
    answer=DevelopAnswer,
    compute="service.computations.further_cameras.compute:develop_raw",
    words="developed raw files",
    order=58,
    demand=lambda _: Demand(memory_mb=2700, limit_s=1800),
)


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


class FurtherCameraArguments(JobRecord):
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


class FurtherCameraAnswer(JobRecord):
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


FURTHER_CAMERA = JobKind(
    name="further_camera",
    arguments=FurtherCameraArguments,
    answer=FurtherCameraAnswer,
    compute="service.computations.further_cameras.compute:further_camera",
    words="further camera",
    version=3,  # reports that light displaces single spheres
    order=62,
    demand=lambda arguments: Demand(
        memory_mb=600 + IMAGE_MB * processes_for(len(arguments.images), IMAGE_MB),
        limit_s=3600 + 120 * len(arguments.images),
    ),
)


class FurtherViewArguments(JobRecord):
    """One image of a further camera.

    Attributes:
        device: name of the camera in rig.yaml.
        image: the viewpoint at which it was taken, and its file.
        calibration: file with the camera's intrinsics, as `calibrate intrinsics` writes it.
        spheres_m: the spheres' centres in the CT.
        radius_m: the spheres' radius.
    """

    device: str
    image: ImageFile
    calibration: Hash
    spheres_m: tuple[Point, ...]
    radius_m: float


class FurtherViewAnswer(JobRecord):
    """The camera's pose by one image.

    Attributes:
        viewpoint: the viewpoint at which the image was taken.
        device: name of the camera in rig.yaml.
        T_ct_camera: the camera's pose by this image alone; None if it shows too few spheres, and `reason` says so.
        reason: the reason why there is no pose.
        black: true if the image is black.
    """

    viewpoint: str
    device: str
    T_ct_camera: Matrix | None = None
    reason: str = ""
    black: bool = False


FURTHER_VIEW = JobKind(
    name="further_view",
    arguments=FurtherViewArguments,
    answer=FurtherViewAnswer,
    compute="service.computations.further_cameras.compute:further_view",
    words="images of further cameras as they arrive",
    order=32,
    replayed=False,
    aside=True,
    demand=lambda _: Demand(memory_mb=1200, limit_s=900),
)

KINDS = (DEVELOP, FURTHER_CAMERA, FURTHER_VIEW)
