"""Job kinds of a hand-held camera: `hand_view` and `hand_board` say after each image where to go next."""

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


class HandViewArguments(HeldArguments, SpecimenArguments):
    """Arguments for an image of the specimen."""


class PlaceStatus(JobRecord):
    """A place of the hemisphere, and whether it has an image."""

    name: str
    T_level_camera: Matrix
    done: bool = False


class HandViewAnswer(JobRecord):
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


HAND_VIEW = JobKind(
    name="hand_view",
    arguments=HandViewArguments,
    answer=HandViewAnswer,
    compute="service.computations.hand_held.compute:hand_view",
    words="images taken by hand",
    version=3,
    order=33,
    replayed=False,
    demand=lambda _: Demand(memory_mb=1200, limit_s=900),
)


class BoardArguments(HemisphereArguments):
    """The board, and the sensor's width, which gives nominal intrinsics with the focal length."""

    columns: int
    rows: int
    square_m: float
    sensor_width_mm: float


class HandBoardArguments(HeldArguments, BoardArguments):
    """Arguments for an image of the board."""


HAND_BOARD = JobKind(
    name="hand_board",
    arguments=HandBoardArguments,
    answer=HandViewAnswer,
    compute="service.computations.hand_held.compute:hand_board",
    words="board images taken by hand",
    order=11,
    replayed=False,
    demand=lambda _: Demand(memory_mb=1200, limit_s=900),
)

KINDS = (HAND_VIEW, HAND_BOARD)
