"""Job kinds of the registration: the outlines of the spheres, and T_world_scan for one source of camera poses."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from service.computations.further_cameras import FurtherCameraAnswer
from service.computations.kind import Demand, JobKind, JobRecord, NoAnswer
from service.computations.records import (
    Camera,
    Hash,
    ImagesCamera,
    Matrix,
    Mounting,
    ParameterCovariance,
    Point,
    PosedPhotograph,
)
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


class DetectSpheresArguments(SceneArguments):
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


DETECT_SPHERES = JobKind(
    name="detect_spheres",
    arguments=DetectSpheresArguments,
    answer=NoAnswer,
    compute="service.computations.registration.compute:detect_spheres",
    words="spheres in images",
    version=3,
    order=60,
    demand=lambda arguments: Demand(
        memory_mb=600 + IMAGE_MB * processes_for(len(arguments.images), IMAGE_MB),
        limit_s=3600 + 120 * len(arguments.images),
    ),
)


ARM = ("robot", "robot_corrected")  # sources of poses that are an arm's
POSE_ERRORS = "pose_errors"  # kind of the artefact with the errors of the poses


class RegisterArguments(SceneArguments):
    """The outlines and the source of the poses, with its model if they come from the images.

    With `state_pose_errors`, which is for poses of an arm and of the spheres, the errors of the poses are estimated
    and stored. Poses of the spheres then follow from the outlines alone, and images that show fewer than four spheres
    have none.
    """

    outlines: Hash
    poses: str
    model: Hash | None = None
    tracks: Hash | None = None
    state_pose_errors: bool = False  # jobs of earlier versions did not


class LeaveOneOut(JobRecord):
    """The mean errors of spheres predicted from the others; of each, radial (mm), reprojection (px), and images."""

    mean_radial_error_mm: float
    mean_reprojection_error_px: float
    spheres: dict[str, tuple[float | int, ...]]


class Contradiction(JobRecord):
    """A contradiction between the inputs, as text, and what to do; `refuses`: before the result is used."""

    kind: str
    what: str
    remedy: str
    refuses: bool = False

    @property
    def text(self) -> str:
        """Both parts, as a line of a report."""
        return f"{self.what}. {self.remedy}"


class CommonError(JobRecord):
    """An error that all outlines share; values are in px, for `focal_x` and `focal_y` relative.

    Attributes:
        name: the error's name.
        value: the value in a fit that leaves it free.
        sigma: the value's standard deviation.
        expected: the standard deviation by which it may differ from zero.
    """

    name: str
    value: float
    sigma: float
    expected: float


class Registration(JobRecord):
    """A registration.

    Attributes:
        poses: the source of the camera poses.
        camera: the camera with which the outlines were detected.
        outlines: the file with the outlines.
        full_camera: the camera at the size of the photographs, if the images were reduced.
        T_world_scan: the scan's pose; the world is the base of the first station, or the reconstruction's own frame.
        scale: the reconstruction's scale; 1 for metric poses.
        rms_px: the rms residual of the outlines that were used.
        T_world_station: the station's pose, by station.
        T_scan_camera: the camera's pose, by viewpoint.
        T_scan_camera_given: the corrected poses of the arm, before the outlines refined them.
        covariance_given: (6, 6) of T_world_scan with these; both are set for corrected poses of the arm only.
        excluded: phrases that name the outlines left out as outliers.
        covariance: (6, 6) of T_world_scan, m and rad.
        components: terms whose sum is the covariance.
        leave_one_out: the result without each sphere; None if a station sees too few spheres for it.
        pose_sigma_m: 1σ of one pose of the arm, along each axis, before the outlines refined it; None: not given.
        pose_sigma_rad: 1σ of its rotation vector.
        findings: contradictions between the inputs; empty in jobs of earlier versions, as the next three.
        left_out: the images that contradict the others, and why; they have no pose.
        common_errors: the errors of the outlines, whose part beyond the model is the component `unexplained`.
        blur_px: the blur of the outlines' edges, in the median.
    """

    poses: str
    camera: Camera
    outlines: Hash
    full_camera: Camera | None = None
    T_world_scan: Matrix
    scale: float
    rms_px: float
    T_world_station: dict[str, Matrix]
    T_scan_camera: dict[str, Matrix]
    T_scan_camera_given: dict[str, Matrix] | None = None
    covariance_given: Matrix | None = None
    excluded: tuple[str, ...] = ()
    covariance: Matrix
    components: dict[str, Matrix]
    leave_one_out: LeaveOneOut | None = None
    pose_sigma_m: float | None = None
    pose_sigma_rad: float | None = None
    findings: tuple[Contradiction, ...] = ()
    left_out: dict[str, str] = Field(default_factory=dict[str, str])
    common_errors: tuple[CommonError, ...] = ()
    blur_px: float | None = None


class Registrations(JobRecord):
    """The registrations in the result of a registration step, by name, and the further cameras of the rig."""

    registrations: dict[str, Registration] = Field(default_factory=dict[str, Registration])
    cameras: dict[str, FurtherCameraAnswer] = Field(default_factory=dict[str, FurtherCameraAnswer])


REGISTER = JobKind(
    name="register",
    arguments=RegisterArguments,
    answer=Registration,
    compute="service.computations.registration.compute:register",
    words="registration",
    version=4,  # reports that light displaces single spheres
    order=61,
    demand=lambda arguments: Demand(memory_mb=500 + len(arguments.images), limit_s=3600 + 20 * len(arguments.images)),
)

KINDS = (DETECT_SPHERES, REGISTER)
