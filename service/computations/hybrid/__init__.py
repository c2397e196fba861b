"""Job kind `hybrid`: bundle adjustment of a model's tracks, the robot's poses and the registration spheres."""

from __future__ import annotations

from service.computations.detect_spheres import SceneArguments
from service.computations.kind import Demand, JobKind, JobRecord, NoAnswer
from service.computations.records import Hash, Matrix


class Arguments(SceneArguments):
    """Outlines, and the model with its tracks from which the adjustment starts."""

    outlines: Hash
    poses: str = "hybrid"
    model: Hash
    tracks: Hash


class HybridModel(JobRecord):
    """The file of the adjusted poses.

    Attributes:
        T_world_camera: the camera's pose by viewpoint.
        pose_covariance: (6, 6) of each T_frame_camera, m and rad.
        pose_covariance_frame: the name of that frame: `scan`.
        T_world_scan: the registration.
        T_world_station: the base of each station.
        scan_covariance: (6, 6) of T_world_scan, m and rad.
        predicted_error_mm: the predicted error at the middle of the spheres.
        sigma_track_px: the standard deviation of one observation of a track.
        sphere_factor: the factor of the outlines' residuals over their own sigmas.
        sigma_robot_m: the standard deviation of a coordinate of the robot's positions; None without a robot.
        sigma_robot_rad: that of its rotations, about each axis; None without a robot.
        chi2: the reduced χ², by kind of observation.
    """

    T_world_camera: dict[str, Matrix]
    pose_covariance: dict[str, Matrix]
    pose_covariance_frame: str
    T_world_scan: Matrix
    T_world_station: dict[str, Matrix]
    scan_covariance: Matrix
    predicted_error_mm: float
    sigma_track_px: float
    sphere_factor: float
    sigma_robot_m: float | None
    sigma_robot_rad: float | None
    chi2: dict[str, float]


KIND = JobKind(
    name="hybrid",
    arguments=Arguments,
    answer=NoAnswer,
    compute="service.computations.hybrid.compute:hybrid",
    words="hybrid camera poses",
    order=51,
    demand=lambda arguments: Demand(memory_mb=600 + 10 * len(arguments.images), limit_s=14400),
)
