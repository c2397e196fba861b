"""Job kind `live_view`: one image, just taken: its spheres, the registration so far, the error to expect."""

from __future__ import annotations

from service.jobs.kind import JobKind, JobRecord
from service.jobs.records import Camera, Hash, Limits, Matrix, Mounting, Photograph, Point


class LiveArguments(Mounting):
    """What every look during a capture by the robot is given.

    Attributes:
        camera: calibrated.
        hand_eye_covariance: (6, 6) of T_flange_camera, m and rad.
        arm_sigma_m: scatter of the camera's poses before any image tells.
        arm_sigma_rad: likewise.
        spheres_m: of the CT.
        radius_m: of the spheres.
        limits: when a view counts for the coverage.
        surface: points of the specimen (`coverage_points`); None while there are none.
    """

    camera: Camera
    hand_eye_covariance: Matrix
    arm_sigma_m: float
    arm_sigma_rad: float
    spheres_m: tuple[Point, ...]
    radius_m: float
    limits: Limits
    surface: Hash | None = None


class Arguments(LiveArguments):
    """The new image, and the files of the looks at the earlier ones."""

    image: Photograph
    earlier: tuple[Hash, ...] = ()


class Answer(JobRecord):
    """Where the image belongs; `reason` says why the images do not determine the registration yet."""

    viewpoint: str
    station: str
    reason: str = ""
    black: bool = False


KIND = JobKind(
    name="live_view",
    arguments=Arguments,
    answer=Answer,
    compute="service.worker.capture.live_view:live_view",
    words="images as they arrive",
    order=31,
    replayed=False,
    aside=True,
)
