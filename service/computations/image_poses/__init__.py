"""Job kinds of camera poses from images: features, matches, structure from motion, and the hybrid with the robot."""

from __future__ import annotations

from typing import Literal

from service.computations.kind import Demand, JobKind, JobRecord, NoAnswer
from service.computations.records import Hash, ImageFile, ImagesCamera, Matrix, PosedPhotograph
from service.computations.registration import SceneArguments


class SfmEffort(JobRecord):
    """The effort of structure from motion; SfmOptions has further fields, and the same defaults.

    Attributes:
        max_image_size: the longer side, px, of the reduced images in which features are searched.
        max_features: the most features of one image.
        neighbours: number of images that each image is matched with.
    """

    max_image_size: int = 3200
    max_features: int = 3000
    neighbours: int = 8


class FrontEndArguments(ImagesCamera):
    """Arguments that features and matches share."""

    effort: SfmEffort


class ImagesToMatch(JobRecord):
    """The images, and the viewpoints that they are to be matched with as soon as those have features."""

    images: tuple[ImageFile, ...]
    match_with: tuple[str, ...] = ()


class FeaturesArguments(ImagesToMatch, FrontEndArguments):
    """The images, and the viewpoints that they are to be matched with as soon as those have features."""


FEATURES = JobKind(
    name="features",
    arguments=FeaturesArguments,
    answer=NoAnswer,
    compute="service.computations.image_poses.compute:features",
    words="features of the images",
    version=3,  # of too many, those with small scales remain
    order=40,
    aside=True,
    demand=lambda arguments: Demand(memory_mb=1100, limit_s=3600 + 300 * len(arguments.images)),
)


class PairsToMatch(JobRecord):
    """Features by viewpoint, and the pairs to match."""

    features: dict[str, Hash]
    pairs: tuple[tuple[str, str], ...]


class MatchArguments(PairsToMatch, FrontEndArguments):
    """Features by viewpoint, and the pairs to match."""


MATCH = JobKind(
    name="match",
    arguments=MatchArguments,
    answer=NoAnswer,
    compute="service.computations.image_poses.compute:match",
    words="matches between images",
    order=41,
    aside=True,
    demand=lambda _: Demand(memory_mb=600, limit_s=14400),
)


class StructureFromMotionArguments(ImagesCamera):
    """The images and options of a reconstruction.

    Attributes:
        images: the images of the captures.
        mappers: the mappers, each of which makes one model.
        effort: the limits on image size, features and pairs.
        prior: T_scan_camera by viewpoint, of an earlier registration; decides which pairs are matched.
        features: the files of features by viewpoint; None in old runs, in which one job did everything.
        matches: the files of matches.
    """

    images: tuple[PosedPhotograph, ...] = ()
    mappers: tuple[Literal["incremental", "global", "triangulated"], ...]
    effort: SfmEffort
    prior: dict[str, Matrix] | None = None
    features: dict[str, Hash] | None = None
    matches: tuple[Hash, ...] = ()


class ModelFile(JobRecord):
    """The part of a file of camera poses that later jobs read: the pose of each image, by viewpoint."""

    T_world_camera: dict[str, Matrix]


STRUCTURE_FROM_MOTION = JobKind(
    name="structure_from_motion",
    arguments=StructureFromMotionArguments,
    answer=NoAnswer,
    compute="service.computations.image_poses.compute:structure_from_motion",
    words="camera poses from images",
    order=50,
    demand=lambda arguments: Demand(
        memory_mb=1000 + 10 * len(arguments.images), limit_s=14400 + 120 * len(arguments.images)
    ),
)


class HybridArguments(SceneArguments):
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


HYBRID = JobKind(
    name="hybrid",
    arguments=HybridArguments,
    answer=NoAnswer,
    compute="service.computations.image_poses.compute:hybrid",
    words="hybrid camera poses",
    order=51,
    demand=lambda arguments: Demand(memory_mb=600 + 10 * len(arguments.images), limit_s=14400),
)

KINDS = (FEATURES, MATCH, STRUCTURE_FROM_MOTION, HYBRID)
