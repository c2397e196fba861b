"""Job kind `hand_view`: an image of a hand-held camera: its pose by the spheres, and where to go next."""

from __future__ import annotations

from pydantic import Field

from service.jobs.kind import JobKind, JobRecord
from service.jobs.records import Camera, Hash, Limits, Matrix, Point


class HeldImage(JobRecord):
    """A photograph of a hand-held camera; `settings` says what departs from those wanted, "" for nothing."""

    viewpoint: str
    sha256: Hash
    settings: str
    focal_mm: float


class PlannedPlace(JobRecord):
    """A place of the hemisphere to be covered."""

    name: str
    tilt_deg: float
    azimuth_deg: float
    distance_m: float
    walk_round: bool
    aim_m: Point


class HeldArguments(JobRecord):
    """What a look at a hand-held image is given, of the specimen or of the board."""

    image: HeldImage
    earlier: tuple[Hash, ...] = ()
    surface: Hash | None = None
    places: tuple[PlannedPlace, ...]
    within_deg: float
    first_words: str
    limits: Limits
    rough: bool = False  # nobody has measured the spheres: the images tell where they are


class Arguments(HeldArguments):
    """Of an image of the specimen."""

    camera: Camera
    spheres_m: tuple[Point, ...]
    radius_m: float
    pose_sigma_m: float
    pose_sigma_rad: float
    limit_m: float
    min_coverage: float
    colour: str | None = None


class ShownPlace(JobRecord):
    """A place of the hemisphere."""

    name: str
    T_level_camera: Matrix
    done: bool = False


class Answer(JobRecord):
    """The verdict on the image, where the camera was, and the way on in words."""

    viewpoint: str
    used: bool
    why: str
    words: str
    target: ShownPlace | None = None
    T_scene_camera: Matrix | None = None
    T_level_camera: Matrix | None = None
    places: tuple[ShownPlace, ...] = ()
    cells: tuple[tuple[int, ...], ...] = ()  # board corners by part of the frame
    spheres_m: tuple[Point, ...] = ()  # as this image and those before it tell them
    T_scene_cameras: dict[str, Matrix] = Field(
        default_factory=dict[str, Matrix]
    )  # of all images, refined by this one


KIND = JobKind(
    name="hand_view",
    arguments=Arguments,
    answer=Answer,
    compute="service.worker.capture.hand_view:hand_view",
    words="images taken by hand",
    order=33,
    replayed=False,
)
