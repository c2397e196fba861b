"""Records that several kinds of jobs share: photographs with poses, cameras, spheres, corrections of an arm."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from service.jobs.kind import JobRecord

Matrix = tuple[tuple[float, ...], ...]  # row by row
Point = tuple[float, float, float]
Hash = str  # SHA-256 of an artefact


def matrix(rows: Iterable[Iterable[float]]) -> Matrix:
    """The rows of an array as a record holds them."""
    return tuple(tuple(float(value) for value in row) for row in rows)


def matrices(arrays: Mapping[str, Iterable[Iterable[float]]]) -> dict[str, Matrix]:
    """Arrays by name as a record holds them."""
    return {name: matrix(rows) for name, rows in arrays.items()}


class Camera(JobRecord):
    """Intrinsics as CameraModel writes them: in pixels, OpenCV's distortion model; k3 … k6 only if not zero.

    Not CameraModel itself, which does not know which of its fields were set: a record is written again with exactly
    the fields that were read, so that the JSON of an event, and with it its hash, stays the same.
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
        reduced_to: width and height to which the photographs are reduced first; None: used at full size.
        full_camera: camera at the size of the photographs, in arguments of version 1 for reduced images.
    """

    camera: Camera
    reduced_to: tuple[int, int] | None = None
    full_camera: Camera | None = None

    @property
    def reduced(self) -> bool:
        """Whether the photographs are reduced first."""
        return self.reduced_to is not None or self.full_camera is not None


class ImageFile(JobRecord):
    """A photograph: its viewpoint and its file."""

    viewpoint: str
    sha256: Hash


class Photograph(ImageFile):
    """A photograph and the pose of its camera.

    Attributes:
        name: of the image in a data set.
        step: in which it was taken.
        station: of the robot; "" without one.
        T_base_flange: as the arm reported it; None if a person held the camera.
        joints_rad: reported with it.
        T_scene_camera: of a hand-held camera, from the spheres in the image.
    """

    name: str = ""
    step: str = ""
    station: str = ""
    T_base_flange: Matrix | None = None
    joints_rad: tuple[float, ...] = ()
    T_scene_camera: Matrix | None = None


class ArmCorrection(JobRecord):
    """The errors of an arm as the hand-eye calibration estimated them, with the corresponding T_flange_camera."""

    T_flange_camera: Matrix
    arm: str
    stations: tuple[str, ...] | None = None  # stations of that arm, in arguments of version 1


class Mounting(JobRecord):
    """How the camera was mounted on the arm.

    Attributes:
        T_flange_camera: for uncorrected poses of the arm; None if a person held the camera.
        arm_correction: of the reported poses; None if they are used uncorrected.
        arm_stations: stations of the corrected arm.
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


class SphereChange(JobRecord):
    """A sphere in two measurements, by its numbers, and how far apart they place it, in the frame of the first."""

    reference: int
    sphere: int
    difference_mm: Point
    sigma_mm: float
    z: float
    moved: bool


class LoopClosure(JobRecord):
    """Two measurements of the same spheres; rms and χ² are of the spheres that did not move."""

    T_reference_mesh: Matrix
    chi2_per_dof: float
    rms_mm: float
    sigma_rms_mm: float
    spheres: tuple[SphereChange, ...]


class SphereDetails(JobRecord):
    """Details on the spheres of a mesh; with an earlier measurement of them, how they moved since."""

    spheres: tuple[MeasuredSphere, ...] = ()
    T_reference_mesh: Matrix | None = None
    loop_closure: LoopClosure | None = None
    layout: dict[str, Any] | None = None  # near-symmetries (service/compute/layout/ambiguity.py)


class SpheresFound(JobRecord):
    """The spheres of a mesh in its own frame, metres."""

    spheres_m: tuple[Point, ...]
    details: SphereDetails = SphereDetails()


class ParameterCovariance(JobRecord):
    """A covariance matrix with the parameters of its rows."""

    parameters: tuple[str, ...]
    matrix: Matrix
