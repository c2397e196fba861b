"""Records that several kinds of jobs share: photographs with their poses, cameras, spheres, the arm's correction."""

from __future__ import annotations

from typing import Any

from service.jobs.kind import JobRecord

Matrix = tuple[tuple[float, ...], ...]  # row by row
Point = tuple[float, float, float]
Hash = str  # SHA-256 of an artefact


class Camera(JobRecord):
    """Intrinsics as CameraModel writes them: pixels, OpenCV's distortion; k3 … k6 only where they are not zero.

    Not CameraModel itself, which computes and does not know which of its fields were set: a record is written out
    again with exactly the fields that were read, so that the JSON of an event, and with it its hash, stays the same.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0


class ImagesCamera(JobRecord):
    """The camera of a job's images.

    Attributes:
        camera: at the size of the photographs, or, with `full_camera`, at that of the reduced images.
        reduced_to: width and height to which the photographs are reduced first; None: they are used as they are.
        full_camera: at the size of the photographs, in arguments of version 1 for reduced images.
    """

    camera: Camera
    reduced_to: tuple[int, int] | None = None
    full_camera: Camera | None = None

    @property
    def reduced(self) -> bool:
        """Whether the photographs are reduced first."""
        return self.reduced_to is not None or self.full_camera is not None


class ImageFile(JobRecord):
    """A photograph by its viewpoint and its file."""

    viewpoint: str
    sha256: Hash


class Photograph(ImageFile):
    """A photograph and where the camera was.

    Attributes:
        name: of the image in a data set.
        step: that took it.
        station: where the robot stood; "" without one.
        T_base_flange: as the arm reported it; None where a person held the camera.
        joints_rad: with it.
        T_scene_camera: of a hand-held camera, by the spheres that the image shows.
    """

    name: str = ""
    step: str = ""
    station: str = ""
    T_base_flange: Matrix | None = None
    joints_rad: tuple[float, ...] = ()
    T_scene_camera: Matrix | None = None


class ArmCorrection(JobRecord):
    """What the hand-eye calibration found of an arm's errors, with the T_flange_camera that goes with it."""

    T_flange_camera: Matrix
    arm: str
    stations: tuple[str, ...] | None = None  # where that arm stood; in arguments of version 1


class Mounting(JobRecord):
    """How the camera sat on the arm.

    Attributes:
        T_flange_camera: with poses as the arm reports them; None where a person held the camera.
        arm_correction: of the reported poses; None where they are taken as they are.
        arm_stations: stations at which the corrected arm stood.
    """

    T_flange_camera: Matrix | None = None
    arm_correction: ArmCorrection | None = None
    arm_stations: tuple[str, ...] | None = None


class BoardSize(JobRecord):
    """The calibration board: inner corners, and the edge of a square in metres."""

    columns: int
    rows: int
    square_m: float


class Limits(JobRecord):
    """When a view counts for a point of the specimen's surface."""

    min_views: int
    max_angle_deg: float
    max_distance_m: float


class MeasuredSphere(JobRecord):
    """A sphere found in a mesh; covariance of its centre in m²."""

    centre_m: Point
    covariance_m2: Matrix
    rms_mm: float  # distance of the mesh's points from the sphere
    radius_residual_mm: float | None = None  # fitted radius minus the known one


class SphereDetails(JobRecord):
    """All that is known of the spheres of a mesh."""

    spheres: tuple[MeasuredSphere, ...] = ()
    layout: dict[str, Any] | None = None  # near-symmetries (compute/registration/layout.py)


class SpheresFound(JobRecord):
    """The spheres of a mesh in its own frame, metres."""

    spheres_m: tuple[Point, ...]
    details: SphereDetails = SphereDetails()


class ParameterCovariance(JobRecord):
    """A covariance with the names of its rows."""

    parameters: tuple[str, ...]
    matrix: Matrix
