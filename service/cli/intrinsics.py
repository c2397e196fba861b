"""`orthocapture calibrate intrinsics`: a camera's intrinsics from images of a board, and the options of a board."""

from __future__ import annotations

import json as json_module
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from drivers.errors import UnreadableFileError
from drivers.photos.photo_file import read_exif
from service.cli.common import (
    JsonOption,
    StrictOption,
    console,
    print_json,
    progress_bar,
    reporting_errors,
    require_writable,
    require_writable_folder,
    write_whole,
)
from service.computations.calibration import Intrinsics
from service.computations.calibration.compute import CalibratedCamera, calibrate_camera
from service.compute.calibration.board import FLATNESS_M, SIZE_TOLERANCE, Board, Pattern
from service.compute.calibration.board_search import UsableViews, find_boards, probe_board, usable_views
from service.compute.calibration.intrinsics import IntrinsicsResult
from service.compute.calibration.intrinsics_adjustment import LensModel
from service.compute.calibration.intrinsics_quality import ProjectionUncertainty, calibration_plots
from service.compute.images.photographs import image_folder, image_size
from service.compute.photography import Optics, compare_optics, states_focus, summary
from service.core.errors import ComputeError, ConfigurationError, DataError
from service.core.units import metres, mm
from service.core.words import counted

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
    """Return the board that the options describe.

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
    """Return the views of a board that can be used, of images searched under a progress bar.

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


_WITHOUT_EXIF = {".pgm", ".ppm", ".pnm"}


def intrinsics_command(
    images: Annotated[Path, typer.Option("--images", help="Folder of the board images.")],
    board: BoardOption,
    square_mm: SquareOption,
    out: Annotated[Path, typer.Option("--out", help="The camera.json to write.")],
    pattern: PatternOption = "checkerboard",
    marker_mm: MarkerOption = None,
    dictionary: DictionaryOption = DEFAULT_DICTIONARY,
    legacy: LegacyOption = False,
    flatness_mm: FlatnessOption = DEFAULT_FLATNESS_MM,
    model: Annotated[
        LensModel,
        typer.Option("--model", help="Distortion: none, k1 k2, + p1 p2, + k3, rational k1 … k6."),
    ] = "opencv4",
    distance_m: Annotated[
        float | None,
        typer.Option("--distance-m", help="Distance of the specimen, for the uncertainty; default: the board's."),
    ] = None,
    capture_images: Annotated[
        Path | None,
        typer.Option("--capture-images", help="Folder of images for this camera; checks that the lens is the same."),
    ] = None,
    report: Annotated[Path | None, typer.Option("--report", help="Folder for plots (PNG).")] = None,
    strict: StrictOption = False,
    json: JsonOption = False,
) -> None:
    """Calibrate a camera from images of a flat board, with its uncertainty."""
    with reporting_errors(json):
        seen = described_board(
            board, square_mm, pattern, marker_mm, dictionary, legacy=legacy, flatness_mm=flatness_mm
        )
        folder = image_folder(images, strict=strict)
        files = folder.files
        require_writable(out)
        if report is not None:
            require_writable_folder(report)
        views = searched(files, seen, quiet=json)
        try:
            found = calibrate_camera(views, seen, model=model, distance_m=distance_m)
        except ComputeError as error:
            raise _with_reasons(error, views, files) from error
        optics, departures = _optics([files[k] for k in found.used], capture_images)
        stated = found.record([file.name for file in files], left_out=folder.left_out, warnings=departures)
        record: dict[str, Any] = {**found.result.camera.record(), **stated.plain(), "optics": optics}
        write_whole(out, json_module.dumps(record, indent=1, allow_nan=False) + "\n")
        if report is not None:
            _write_plots(report, found.result, found.uncertainty)
        if json:
            print_json(record)
            return
        _tell(stated, found)
        console.print(f"written: {out}")


def _with_reasons(error: ComputeError, views: UsableViews, files: Sequence[Path]) -> ComputeError:
    """Return the error with the first images that were excluded before the estimation, and why."""
    reasons = "".join(f"; {files[k].name}: {reason}" for k, reason in sorted(views.excluded.items())[:5])
    return ComputeError(error.what + reasons, where=error.where, remedy=error.remedy)


def _optics(calibration: Sequence[Path], capture_folder: Path | None) -> tuple[dict[str, Any], list[str]]:
    """Return changes of the optics between the images, as a record and as warnings."""
    calibrated = [optics_of(file) for file in calibration]
    within = compare_optics(calibrated, calibrated)
    record: dict[str, Any] = {"calibration_departures": [str(departure) for departure in within.departures]}
    warnings = [f"the lens changed during the calibration: {line}" for line in summary(within.departures)]
    if not states_focus(calibrated):
        warnings.append("the images do not state the focus distance: a change of focus would go unnoticed")
    if capture_folder is not None:
        comparison = compare_optics(calibrated, [optics_of(file) for file in image_folder(capture_folder).files])
        record |= {
            "capture_departures": [str(departure) for departure in comparison.departures],
            "capture_images": list(comparison.images),
            "compared": list(comparison.compared),
            "not_stated": list(comparison.unknown),
        }
        warnings += [f"the lens is not as it was calibrated: {line}" for line in summary(comparison.departures)]
        # Width and height are always compared; without focal length and aperture nothing is known about the lens.
        if not {"focal_length_mm", "aperture_f"} & set(comparison.compared):
            warnings.append("the images state neither focal length nor aperture: a change would go unnoticed")
    return record, warnings


def optics_of(file: Path) -> Optics:
    """Return the optics in a file's EXIF.

    Raises:
        DataError: the file is not an image.
    """
    if file.suffix.lower() in _WITHOUT_EXIF:
        width, height = image_size(file)
        return Optics(image=file.name, width=width, height=height)
    try:
        exif = read_exif(file)
    except UnreadableFileError as error:
        raise DataError(error.what, where=error.where, remedy=error.remedy) from error
    return Optics(
        image=file.name,
        width=exif.width,
        height=exif.height,
        focal_length_mm=exif.focal_length_mm,
        aperture_f=exif.aperture_f,
        focus_distance_m=exif.focus_distance_m,
        focus_mode=exif.focus_mode,
        focus_position=exif.focus_position,
        lens=exif.lens,
        lens_serial=exif.lens_serial,
        body=f"{exif.make} {exif.model}".strip(),
        body_serial=exif.body_serial,
    )


def _write_plots(folder: Path, result: IntrinsicsResult, uncertainty: ProjectionUncertainty) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, png in calibration_plots(result, uncertainty).items():
            (folder / name).write_bytes(png)
    except OSError as error:
        raise DataError(f"the report cannot be written: {error.strerror}", where=str(folder)) from error


def _tell(record: Intrinsics, found: CalibratedCamera) -> None:
    result, validation, uncertainty = found.result, found.validation, found.uncertainty
    held_out = "" if validation is None else f", {validation.five_fold_rms_px:.3f} px held out"
    console.print(f"{counted(len(result.views), 'view')}, {result.rms_px:.3f} px rms{held_out}")
    for name in result.parameters:
        console.print(f"  {name:<3} {getattr(result.camera, name):14.6g} ± {result.sigma[name]:.2g}")
    if record.board is not None and record.board.bow_words:
        console.print(f"the board is bent by {record.board.bow_words}")
    console.print(
        f"projection at {uncertainty.distance_m:.2f} m known to {uncertainty.centre_px:.3f} px "
        f"({uncertainty.centre_mm:.4f} mm) at the centre, {uncertainty.worst_px:.3f} px "
        f"({uncertainty.worst_mm:.4f} mm) at worst"
    )
    for view in record.excluded:
        console.tell(("left out", "yellow"), f" {view.image}: {view.reason}")
    for warning in record.warnings:
        console.tell(("warning", "yellow"), f" {warning}")
