"""Job kind `develop`: a raw file, developed with fixed parameters to a linear TIFF that matches its JPEG."""

from __future__ import annotations

from service.computations.kind import Demand, JobKind, JobRecord
from service.computations.records import Hash
from service.compute.photography import Crop, DevelopParameters


class Arguments(JobRecord):
    """The raw file and the JPEG of one exposure, and how the raw file is developed."""

    viewpoint: str
    raw: Hash
    jpeg: Hash
    parameters: DevelopParameters


class Answer(JobRecord):
    """The development of a raw file.

    Attributes:
        raw: SHA-256 of the raw file.
        parameters: the parameters that were asked for.
        white_balance: the gains that the camera recorded, of red, green, blue and second green.
        black_level: the black levels of the four photosites of the pattern.
        white_level: the largest of the sensor's values.
        area: width and height of the exposed area, px.
        crop: the picture's place in it.
        shift_px: the median shift of the picture against the JPEG, in x and y.
        largest_shift_px: the largest shift of a part of the picture.
        rawpy: the version of rawpy.
        libraw: the version of LibRaw.
    """

    raw: Hash
    parameters: DevelopParameters
    white_balance: tuple[float, ...]
    black_level: tuple[int, ...]
    white_level: int
    area: tuple[int, int]
    crop: Crop
    shift_px: tuple[float, float]
    largest_shift_px: float
    rawpy: str
    libraw: str


KIND = JobKind(
    name="develop",
    arguments=Arguments,
    answer=Answer,
    compute="service.computations.develop.compute:develop_raw",
    words="developed raw files",
    order=58,
    demand=lambda _: Demand(memory_mb=2700, limit_s=1800),
)
