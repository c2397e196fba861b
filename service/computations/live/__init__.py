"""Job kinds during a capture: `live_view` of each image, `live_summary` of a station, `coverage_points` once."""

from __future__ import annotations

from service.computations.kind import Demand, JobKind, JobRecord, NoAnswer
from service.computations.records import Camera, Hash, Limits, Matrix, Mounting, Point, PosedPhotograph


class CoveragePointsArguments(JobRecord):
    """The CT's mesh and the spheres in it."""

    mesh: Hash
    spheres_m: tuple[Point, ...]
    radius_m: float
    limits: Limits


COVERAGE_POINTS = JobKind(
    name="coverage_points",
    arguments=CoveragePointsArguments,
    answer=NoAnswer,
    compute="service.computations.live.compute:coverage_points",
    words="the specimen's surface",
    order=30,
    replayed=False,
    aside=True,
    demand=lambda _: Demand(memory_mb=1400, limit_s=1800),
)


class LiveArguments(Mounting):
    """Arguments of all jobs during a capture by the robot.

    Attributes:
        camera: the calibrated camera.
        hand_eye_covariance: (6, 6) of T_flange_camera, m and rad.
        arm_sigma_m: the prior scatter of the camera's positions.
        arm_sigma_rad: the prior scatter of the camera's rotations.
        spheres_m: the spheres' centres in the CT.
        radius_m: the spheres' radius.
        limits: the conditions on which a view counts for the coverage.
        surface: the file of the job `coverage_points`; None until it has finished.
    """

    camera: Camera
    hand_eye_covariance: Matrix
    arm_sigma_m: float
    arm_sigma_rad: float
    spheres_m: tuple[Point, ...]
    radius_m: float
    limits: Limits
    surface: Hash | None = None


class LiveViewArguments(LiveArguments):
    """The new image, and the files of this job for the earlier ones."""

    image: PosedPhotograph
    earlier: tuple[Hash, ...] = ()


class LiveViewAnswer(JobRecord):
    """The image and its station; `reason` says why the images do not determine the registration yet."""

    viewpoint: str
    station: str
    reason: str = ""
    black: bool = False


LIVE_VIEW = JobKind(
    name="live_view",
    arguments=LiveViewArguments,
    answer=LiveViewAnswer,
    compute="service.computations.live.compute:live_view",
    words="images as they arrive",
    order=31,
    replayed=False,
    aside=True,
    demand=lambda _: Demand(memory_mb=1200, limit_s=900),
)


class CandidateView(JobRecord):
    """A view that could be taken in addition."""

    name: str
    T_base_camera: Matrix
    travel_s: float


class LiveSummaryArguments(LiveArguments):
    """The files of all `live_view` jobs, and further views at the robot's present station."""

    views: tuple[Hash, ...]
    station: str
    limit_m: float
    min_coverage: float
    candidates: tuple[CandidateView, ...]


class Suggestion(JobRecord):
    """A view that would help; error and coverage (0 … 1) are predicted with it and the suggestions before it."""

    viewpoint: str
    predicted_error_mm: float
    coverage: float


class StationPrediction(JobRecord):
    """The predicted error from the images of a station so far."""

    predicted_target_error_mm: float
    images: int


class LiveSummaryAnswer(JobRecord):
    """The views to take next, and why some stations cannot be registered yet."""

    next_best_views: tuple[Suggestion, ...]
    reasons: dict[str, str]
    stations: dict[str, StationPrediction]


LIVE_SUMMARY = JobKind(
    name="live_summary",
    arguments=LiveSummaryArguments,
    answer=LiveSummaryAnswer,
    compute="service.computations.live.compute:live_summary",
    words="summary of the images",
    order=32,
    replayed=False,
    aside=True,
    demand=lambda _: Demand(memory_mb=600, limit_s=600),
)

KINDS = (COVERAGE_POINTS, LIVE_VIEW, LIVE_SUMMARY)
