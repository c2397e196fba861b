"""Options that describe a calibration board, shared by the commands that search for one."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from service.cli.common import progress_bar
from service.compute.board.board import FLATNESS_M, SIZE_TOLERANCE, Board, Pattern
from service.compute.board.search import UsableViews, find_boards, probe_board, usable_views
from service.core.errors import ComputeError, ConfigurationError
from service.core.units import metres, mm

_SQUARE_MM = (0.5, 1000.0)  # plausible squares; anything else is probably in another unit

BoardOption = Annotated[
    str,
    typer.Option(
        "--board",
        metavar="COLSxROWS",
        help="Number of inner corners, where four squares meet: 16x23 for a board of 17 × 24 squares, ChArUco boards "
        "included. For circles: number in a row, and number of rows.",
    ),
]
SquareOption = Annotated[
    float, typer.Option("--square-mm", help="Side of a square; for circles, the distance between two rows.")
]
PatternOption = Annotated[Pattern, typer.Option("--pattern", help="The printed pattern.")]
MarkerOption = Annotated[
    float | None, typer.Option("--marker-mm", help="Side of a ChArUco marker; default: ¾ of a square.")
]
DictionaryOption = Annotated[str, typer.Option("--dictionary", help="Dictionary of the ChArUco markers.")]
LegacyOption = Annotated[
    bool, typer.Option("--legacy", help="The ChArUco board was made by OpenCV before version 4.6.")
]
SizeToleranceOption = Annotated[
    float,
    typer.Option(
        "--size-tolerance-percent",
        min=0.0,
        max=20.0,
        help="Largest error of the square's side, in percent of it, as its maker states it; 0: exactly known.",
    ),
]
FlatnessOption = Annotated[
    float,
    typer.Option(
        "--flatness-mm", min=0.0, max=5.0, help="Largest bow of the board, as its maker states it; 0: exactly flat."
    ),
]
DEFAULT_FLATNESS_MM = mm(FLATNESS_M)
DEFAULT_DICTIONARY = "DICT_5X5_1000"
DEFAULT_SIZE_TOLERANCE_PERCENT = 100 * SIZE_TOLERANCE


def described_board(
    board: str,
    square_mm: float,
    pattern: Pattern,
    marker_mm: float | None,
    dictionary: str,
    *,
    legacy: bool,
    size_tolerance_percent: float = DEFAULT_SIZE_TOLERANCE_PERCENT,
    flatness_mm: float = DEFAULT_FLATNESS_MM,
) -> Board:
    """The board that the options describe.

    Raises:
        typer.BadParameter: the counts are not COLSxROWS.
        ConfigurationError: the size of a square is implausible.
        DataError: no such board is possible.
    """
    columns, _, rows = board.lower().replace("×", "x").partition("x")
    if not (columns.isdigit() and rows.isdigit()):
        raise typer.BadParameter(f"--board takes COLSxROWS such as 16x23, not {board!r}")
    low, high = _SQUARE_MM
    if not low <= square_mm <= high:
        likely = f"; {mm(square_mm):g} for a square of {square_mm:g} m" if 0 < square_mm < low else ""
        raise ConfigurationError(
            f"squares of {square_mm:g} mm are implausible; boards have {low:g} to {high:g} mm",
            where="--square-mm",
            remedy=f"Give the side of a square in millimetres{likely}",
        )
    marker_m = None if marker_mm is None else metres(marker_mm)
    tolerance, flatness_m = size_tolerance_percent / 100, metres(flatness_mm)
    return Board(
        int(columns), int(rows), metres(square_mm), pattern, marker_m, dictionary, legacy, tolerance, flatness_m
    )


def searched(files: Sequence[Path], board: Board, *, quiet: bool) -> UsableViews:
    """The views of a board that can be used, of images searched under a progress bar.

    Raises:
        ComputeError: a sample of the images shows a board other than the one described, or no view can be used.
    """
    _require(files, board)
    with progress_bar(quiet=quiet) as progress:
        found = find_boards(
            files,
            board,
            workers=os.cpu_count() or 1,
            progress=lambda done, total: progress("board images", done, total),
        )
    return usable_views(found)


def _require(files: Sequence[Path], board: Board) -> None:
    if board.pattern == "charuco":
        board.charuco()
    wrong = probe_board(files, board)
    if wrong is not None:
        raise ComputeError(f"the images show another board: {wrong.words}", remedy=wrong.remedy)
