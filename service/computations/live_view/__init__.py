"""Job kind `live_view`: finds the spheres in an image just taken, and registers the images so far."""

from __future__ import annotations

from service.computations.kind import Demand, JobKind, JobRecord
from service.computations.records import Camera, Hash, Limits, Matrix, Mounting, Point, PosedPhotograph


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


class Arguments(LiveArguments):
    """The new image, and the files of this job for the earlier ones."""

    image: PosedPhotograph
    earlier: tuple[Hash, ...] = ()


class Answer(JobRecord):
    """The image and its station; `reason` says why the images do not determine the registration yet."""

    viewpoint: str
    station: str
    reason: str = ""
    black: bool = False


KIND = JobKind(
    name="live_view",
    arguments=Arguments,
    answer=Answer,
    compute="service.computations.live_view.compute:live_view",
    words="images as they arrive",
    order=31,
    replayed=False,
    aside=True,
    demand=lambda _: Demand(memory_mb=1200, limit_s=900),
)
