"""Job kind `hand_view`: locates a hand-held camera by the spheres, and says where it should go next."""

from __future__ import annotations

from pydantic import Field

from service.computations.kind import Demand, JobKind, JobRecord
from service.computations.records import Camera, Hash, Limits, Matrix, ParameterCovariance, Point


class HeldImage(JobRecord):
    """A photograph of a hand-held camera; `settings` says which settings are wrong, "" if none are."""

    viewpoint: str
    sha256: Hash
    settings: str
    focal_mm: float


class PlannedPlace(JobRecord):
    """A camera place on the hemisphere to be covered."""

    name: str
    tilt_deg: float
    azimuth_deg: float
    distance_m: float
    walk_round: bool
    aim_m: Point


class HemisphereArguments(JobRecord):
    """The part that the jobs on all hand-held images of a step share: the hemisphere to be covered."""

    places: tuple[PlannedPlace, ...]
    within_deg: float
    first_words: str
    limits: Limits
    rough: bool = False  # the spheres have not been measured: the images locate them


class HeldArguments(HemisphereArguments):
    """Arguments of the job on one hand-held image, of the specimen or of the board."""

    image: HeldImage
    earlier: tuple[Hash, ...] = ()
    surface: Hash | None = None


class SpecimenArguments(HemisphereArguments):
    """The part that the jobs on all images of the specimen share: the camera, the spheres and the limits.

    Jobs of earlier versions predicted errors without those of the calibration and of the scan.
    """

    camera: Camera
    spheres_m: tuple[Point, ...]
    radius_m: float
    pose_sigma_m: float
    pose_sigma_rad: float
    limit_m: float
    min_coverage: float
    colour: str | None = None
    intrinsics_covariance: Matrix | ParameterCovariance | None = None
    scan_sigma_m: float = 0.0


class Arguments(HeldArguments, SpecimenArguments):
    """Arguments for an image of the specimen."""


class PlaceStatus(JobRecord):
    """A place of the hemisphere, and whether it has an image."""

    name: str
    T_level_camera: Matrix
    done: bool = False


class Answer(JobRecord):
    """The image's use, the camera's pose, and directions to the next place."""

    viewpoint: str
    used: bool
    why: str
    words: str
    target: PlaceStatus | None = None
    T_scene_camera: Matrix | None = None
    T_level_camera: Matrix | None = None
    places: tuple[PlaceStatus, ...] = ()
    cells: tuple[tuple[int, ...], ...] = ()  # number of board corners in each cell of the frame
    spheres_m: tuple[Point, ...] = ()  # the spheres as the images up to this one locate them
    T_scene_cameras: dict[str, Matrix] = Field(
        default_factory=dict[str, Matrix]
    )  # of all images, refined by this one


KIND = JobKind(
    name="hand_view",
    arguments=Arguments,
    answer=Answer,
    compute="service.computations.hand_view.compute:hand_view",
    words="images taken by hand",
    version=3,
    order=33,
    replayed=False,
    demand=lambda _: Demand(memory_mb=1200, limit_s=900),
)
