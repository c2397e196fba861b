"""Job kind `features`: SIFT features of some images, one file for each."""

from __future__ import annotations

from service.computations.kind import Demand, JobKind, JobRecord, NoAnswer
from service.computations.records import ImageFile, ImagesCamera


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


class Arguments(ImagesToMatch, FrontEndArguments):
    """The images, and the viewpoints that they are to be matched with as soon as those have features."""


KIND = JobKind(
    name="features",
    arguments=Arguments,
    answer=NoAnswer,
    compute="service.computations.features.compute:features",
    words="features of the images",
    version=3,  # of too many, those with small scales remain
    order=40,
    aside=True,
    demand=lambda arguments: Demand(memory_mb=1100, limit_s=3600 + 300 * len(arguments.images)),
)
