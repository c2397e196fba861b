"""Job kind `structure_from_motion`: camera poses and tracks from features and matches."""

from __future__ import annotations

from typing import Literal

from service.computations.features import SfmEffort
from service.computations.kind import Demand, JobKind, JobRecord, NoAnswer
from service.computations.records import Hash, ImagesCamera, Matrix, PosedPhotograph


class Arguments(ImagesCamera):
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


KIND = JobKind(
    name="structure_from_motion",
    arguments=Arguments,
    answer=NoAnswer,
    compute="service.computations.structure_from_motion.compute:structure_from_motion",
    words="camera poses from images",
    order=50,
    demand=lambda arguments: Demand(
        memory_mb=1000 + 10 * len(arguments.images), limit_s=14400 + 120 * len(arguments.images)
    ),
)
