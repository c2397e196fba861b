"""Records that several kinds of jobs share: photographs with poses, cameras, spheres, corrections of an arm."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from pydantic import Field

from service.computations.kind import JobRecord
from service.core.records.run_events import Uncertainty
from service.core.run.state import JobState

Matrix = tuple[tuple[float, ...], ...]  # row by row
Point = tuple[float, float, float]
Hash = str  # SHA-256 of an artefact


def matrix(rows: Iterable[Iterable[float]]) -> Matrix:
    """Return the rows of an array as a record holds them."""
    return tuple(tuple(float(value) for value in row) for row in rows)


def matrices(arrays: Mapping[str, Iterable[Iterable[float]]]) -> dict[str, Matrix]:
    """Return arrays by name as a record holds them."""
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
        camera: the camera at the size of the photographs, or, with `full_camera`, at that of the reduced images.
        reduced_to: width and height to which the photographs are reduced first; None: used at full size.
        full_camera: camera at the size of the photographs, in arguments of version 1 for reduced images.
    """

    camera: Camera
    reduced_to: tuple[int, int] | None = None
    full_camera: Camera | None = None

    @property
    def reduced(self) -> bool:
        """True if the photographs are reduced first."""
        return self.reduced_to is not None or self.full_camera is not None


class ImageFile(JobRecord):
    """A photograph: its viewpoint and its file."""

    viewpoint: str
    sha256: Hash


class PosedPhotograph(ImageFile):
    """A photograph and the pose of its camera.

    Attributes:
        name: the image's name in a data set.
        step: the step in which it was taken.
        station: the robot's station; "" without one.
        T_base_flange: the flange's pose as the arm reported it, (4, 4); None if a person held the camera.
        joints_rad: the joints reported with it.
        T_scene_camera: the pose of a hand-held camera, from the spheres in the image, (4, 4).
    """

    name: str = ""
    step: str = ""
    station: str = ""
    T_base_flange: Matrix | None = None
    joints_rad: tuple[float, ...] = ()
    T_scene_camera: Matrix | None = None


class ArmCorrection(JobRecord):
    """The errors of an arm as the hand-eye calibration estimated them, for N joints.

    Attributes:
        T_flange_camera: the camera's pose on the flange, for corrected poses.
        arm: the name of the arm's model.
        model: a phrase that names the parameters of the correction.
        dh_deltas: (N, 5) added to a, d (metres), α, θ, β (radians) of each joint; (N, 4), without β, in records of
            the camera calibration before version 4.
        gear_cos_rad, gear_sin_rad: (N, H) amplitudes of the periodic errors of each joint.
        observed: the share of each joint's error that the images determine, 0 … 1.
    """

    T_flange_camera: Matrix
    arm: str
    model: str = ""
    dh_deltas: Matrix
    gear_cos_rad: Matrix
    gear_sin_rad: Matrix
    observed: tuple[float, ...]
    stations: tuple[str, ...] | None = None  # stations of that arm, in arguments of version 1


class FurtherArm(JobRecord):
    """The camera's mounting on another arm of the rig, calibrated on its own.

    Attributes:
        T_flange_camera: the camera's pose on the flange, for uncorrected poses of this arm.
        arm_correction: the correction of its reported poses; None if they are used uncorrected.
        stations: the stations at which this arm stood.
    """

    T_flange_camera: Matrix
    arm_correction: ArmCorrection | None = None
    stations: tuple[str, ...]


class Mounting(JobRecord):
    """The camera's mounting on the arm.

    Attributes:
        T_flange_camera: the camera's pose on the flange, for uncorrected poses of the arm; None if a person held the
            camera, or the mount is unknown.
        arm_correction: the correction of the reported poses; None if they are used uncorrected.
        arm_stations: the stations of the corrected arm.
        further_arms: the arms that carried the camera at other stations.
    """

    T_flange_camera: Matrix | None = None
    arm_correction: ArmCorrection | None = None
    arm_stations: tuple[str, ...] | None = None
    further_arms: tuple[FurtherArm, ...] = ()


def has_poses(mounting: Mounting, images: Sequence[PosedPhotograph]) -> bool:
    """Return whether the poses of images are known before their registration.

    Those of images from an arm with an unknown mount, or from a turntable, are not.
    """
    if all(image.T_scene_camera is not None for image in images):
        return True
    return mounting.T_flange_camera is not None and all(image.T_base_flange is not None for image in images)


class BoardSize(JobRecord):
    """The calibration board: inner corners, and the edge of a square in metres."""

    columns: int
    rows: int
    square_m: float


class Limits(JobRecord):
    """The limits within which a view counts for a point of the specimen's surface."""

    min_views: int
    max_angle_deg: float
    max_distance_m: float


class MeasuredSphere(JobRecord):
    """A sphere found in a mesh.

    Attributes:
        centre_m: its centre in the mesh's frame.
        covariance_m2: the centre's covariance, (3, 3).
        sigma_mm: the root of the covariance's trace.
        rms_mm: the rms distance of the mesh's points from the sphere.
        radius_residual_mm: fitted radius minus the known one.
        radius_sigma_mm: standard deviation of `radius_residual_mm`.
        coverage: the share of the sphere's surface that the mesh has.
        n_points: the number of points that were used.
    """

    centre_m: Point
    covariance_m2: Matrix
    sigma_mm: float | None = None
    rms_mm: float
    radius_residual_mm: float | None = None
    radius_sigma_mm: float | None = None
    coverage: float | None = None
    n_points: int | None = None


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


class SphereConfusion(JobRecord):
    """A wrong assignment of spheres that nearly fits, and its rms distance after the best rigid motion."""

    spheres: tuple[int, ...]
    taken_for: tuple[int, ...]
    misfit_mm: float


class JudgedLayout(JobRecord):
    """The judgement of how well the spheres of a layout can be distinguished (service/compute/layout/ambiguity.py).

    Attributes:
        passed: true if nothing must be changed.
        problems: the things that must be changed.
        margin_mm: the least misfit of a wrong assignment of four spheres.
        margin_sigma_mm: its standard deviation.
        bounds: the uncertainty of each measure of the layout, mm.
        margin_by_count_mm: the least misfit by number of visible spheres.
        worst: the assignments with the least misfit.
        depth_mm: rms distance of the centres from their best plane.
        extent_mm: rms distance of the centres from their mean.
        largest_gap_deg: largest angle around the scene without a sphere.
    """

    passed: bool = False
    problems: tuple[str, ...] = ()
    margin_mm: float | None = None
    margin_sigma_mm: float | None = None
    bounds: dict[str, Uncertainty] = Field(default_factory=dict[str, Uncertainty])
    margin_by_count_mm: dict[str, float] = Field(default_factory=dict[str, float])
    worst: tuple[SphereConfusion, ...] = ()
    depth_mm: float | None = None
    extent_mm: float | None = None
    largest_gap_deg: float | None = None


class SphereDetails(JobRecord):
    """Details on the spheres of a mesh; with an earlier measurement of them, how they moved since."""

    spheres: tuple[MeasuredSphere, ...] = ()
    T_reference_mesh: Matrix | None = None
    loop_closure: LoopClosure | None = None
    layout: JudgedLayout | None = None


class SpheresFound(JobRecord):
    """The spheres of a mesh in its own frame, metres."""

    spheres_m: tuple[Point, ...]
    details: SphereDetails = SphereDetails()


class ParameterCovariance(JobRecord):
    """A covariance matrix with the parameters of its rows."""

    parameters: tuple[str, ...]
    matrix: Matrix


def image_of(job: JobState) -> ImageFile:
    """Return the photograph that such a job was given. Raises ValidationError for a job of another kind."""
    return ImageFile.model_validate(job.arguments["image"])
