"""Job kind `hand_board`: locates a hand-held camera by the board, and says where it should go next."""

from __future__ import annotations

from service.computations.hand_view import Answer, HeldArguments, HemisphereArguments
from service.computations.kind import Demand, JobKind


class BoardArguments(HemisphereArguments):
    """The board, and the sensor's width, which gives nominal intrinsics with the focal length."""

    columns: int
    rows: int
    square_m: float
    sensor_width_mm: float


class Arguments(HeldArguments, BoardArguments):
    """Arguments for an image of the board."""


KIND = JobKind(
    name="hand_board",
    arguments=Arguments,
    answer=Answer,
    compute="service.computations.hand_board.compute:hand_board",
    words="board images taken by hand",
    order=11,
    replayed=False,
    demand=lambda _: Demand(memory_mb=1200, limit_s=900),
)
