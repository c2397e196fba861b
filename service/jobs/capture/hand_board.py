"""Job kind `hand_board`: an image of the board of a hand-held camera: its pose by the nominal lens, the way on."""

from __future__ import annotations

from service.jobs.capture.hand_view import Answer, HeldArguments
from service.jobs.kind import JobKind


class Arguments(HeldArguments):
    """The image, the board, and the sensor's width, which with the focal length makes a nominal camera."""

    columns: int
    rows: int
    square_m: float
    sensor_width_mm: float


KIND = JobKind(
    name="hand_board",
    arguments=Arguments,
    answer=Answer,
    compute="service.worker.capture.hand_board:hand_board",
    words="board images taken by hand",
    order=11,
    replayed=False,
)
