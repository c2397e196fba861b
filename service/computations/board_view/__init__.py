"""Job kind `board_view`: searches one image for the calibration board as soon as it arrives."""

from __future__ import annotations

from service.computations.kind import Demand, JobKind, JobRecord
from service.computations.records import BoardSize, ImageFile


class Arguments(BoardSize):
    """The image and the board."""

    image: ImageFile


class Answer(JobRecord):
    """The board as an image shows it; its corners are in the job's file. `size` is width and height in pixels."""

    viewpoint: str
    size: tuple[int, int]
    seen: bool
    reason: str
    black: bool = False


class Corners(JobRecord):
    """The file of an answer: the image's size, and the board's corners that it shows, by index and in pixels."""

    size: tuple[int, int]
    indices: tuple[int, ...]
    corners: tuple[tuple[float, float], ...]


KIND = JobKind(
    name="board_view",
    arguments=Arguments,
    answer=Answer,
    compute="service.computations.board_view.compute:board_view",
    words="board images",
    order=10,
    replayed=False,
    demand=lambda _: Demand(memory_mb=1200, limit_s=900),
)
