"""The options that describe a calibration board, alike for every command that looks for one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from service.compute.calibration.board.board import Board, Pattern
from service.compute.calibration.board.images import probe_board
from service.core.errors import ComputeError, ConfigurationError
from service.core.units import metres, mm

_SQUARE_MM = (0.5, 1000.0)  # what is printed on boards; a square in metres or micrometres is a slip of the unit

BoardOption = Annotated[
    str,
    typer.Option(
        "--board",
        metavar="COLSxROWS",
        help="Inner corners, where four squares meet: 16x23 for a board of 17 × 24 squares; of a ChArUco board "
        "too. Of circles: in a row, and rows.",
    ),
]
SquareOption = Annotated[
    float, typer.Option("--square-mm", help="Side of a square; of circles the distance between two rows.")
]
PatternOption = Annotated[Pattern, typer.Option("--pattern", help="What is printed.")]
MarkerOption = Annotated[
    float | None, typer.Option("--marker-mm", help="Side of a ChArUco marker; without: ¾ of a square.")
]
DictionaryOption = Annotated[str, typer.Option("--dictionary", help="Of the ChArUco markers.")]
LegacyOption = Annotated[
    bool, typer.Option("--legacy", help="A ChArUco board as OpenCV printed it before version 4.6.")
]
DEFAULT_DICTIONARY = "DICT_5X5_1000"


def described_board(
    board: str, square_mm: float, pattern: Pattern, marker_mm: float | None, dictionary: str, *, legacy: bool
) -> Board:
    """The board that the options describe.

    Raises:
        typer.BadParameter: the counts are not COLSxROWS.
        ConfigurationError: a square that nobody prints.
        DataError: a board that cannot be.
    """
    columns, _, rows = board.lower().replace("×", "x").partition("x")
    if not (columns.isdigit() and rows.isdigit()):
        raise typer.BadParameter(f"--board takes COLSxROWS such as 16x23, not {board!r}")
    low, high = _SQUARE_MM
    if not low <= square_mm <= high:
        likely = f"; {mm(square_mm):g} for a square of {square_mm:g} m" if 0 < square_mm < low else ""
        raise ConfigurationError(
            f"squares of {square_mm:g} mm are not what boards have ({low:g} to {high:g} mm)",
            where="--square-mm",
            remedy=f"Give the side of a square in millimetres{likely}",
        )
    marker_m = None if marker_mm is None else metres(marker_mm)
    return Board(int(columns), int(rows), metres(square_mm), pattern, marker_m, dictionary, legacy)


def require_board(files: Sequence[Path], board: Board) -> None:
    """Raise ComputeError where a few of the images tell that the board is another than the one described."""
    if board.pattern == "charuco":
        board.charuco()
    wrong = probe_board(files, board)
    if wrong is not None:
        raise ComputeError(f"the images show another board: {wrong.words}", remedy=wrong.remedy)
