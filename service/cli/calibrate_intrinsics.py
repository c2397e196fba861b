"""`orthocapture calibrate intrinsics`: a camera from images of a board."""

from __future__ import annotations

import dataclasses
import json as json_module
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer

from service.cli.common import JsonOption, console, print_json, progress_bar, reporting_errors
from service.compute.calibration.intrinsics import calibrate_intrinsics, detect_board
from service.compute.images import read_image
from service.core.errors import ComputeError, DataError

_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}


def intrinsics_command(
    images: Annotated[Path, typer.Option("--images", help="Folder of the board images.")],
    board: Annotated[str, typer.Option("--board", help="COLUMNSxROWS of inner corners, such as 16x23.")],
    square_mm: Annotated[float, typer.Option("--square-mm", help="Side of a square.")],
    out: Annotated[Path, typer.Option("--out", help="The camera.json to write.")],
    json: JsonOption = False,
) -> None:
    """Calibrate the camera's focal lengths, principal point and distortion from images of a flat board."""
    with reporting_errors(json):
        columns, _, rows = board.lower().partition("x")
        if not (columns.isdigit() and rows.isdigit()):
            raise typer.BadParameter(f"--board takes COLUMNSxROWS such as 16x23, not {board!r}")
        files = sorted(file for file in images.glob("*") if file.suffix.lower() in _SUFFIXES)
        if not files:
            raise DataError("no image in this folder", where=str(images), remedy="JPEG, PNG or TIFF files are read")
        found: list[np.ndarray] = []
        excluded: list[dict[str, str]] = []
        names: list[str] = []
        size = (0, 0)
        with progress_bar(quiet=json) as progress:
            for done, file in enumerate(files, start=1):
                grey = np.asarray(cv2.cvtColor(read_image(file), cv2.COLOR_BGR2GRAY), dtype=np.uint8)
                size = (grey.shape[1], grey.shape[0])
                try:
                    found.append(detect_board(grey, int(columns), int(rows)))
                    names.append(file.name)
                except ComputeError as error:
                    excluded.append({"image": file.name, "reason": error.what})
                progress("board images", done, len(files))
        result = calibrate_intrinsics(found, square_mm * 1e-3, int(columns), int(rows), size)
        excluded += [{"image": names[view.index], "reason": view.reason} for view in result.excluded]
        record = {
            **dataclasses.asdict(result.camera),
            "rms_px": result.rms_px,
            "per_view_rms_px": dict(zip((names[k] for k in result.views), result.per_view_rms_px.tolist(), strict=True)),
            "sigma": dict(result.sigma),
            "n_views": len(result.views),
            "excluded": excluded,
        }
        out.write_text(json_module.dumps(record, indent=1) + "\n", encoding="utf-8")
        if json:
            print_json(record)
            return
        console.print(f"{len(result.views)} views, {result.rms_px:.3f} px rms")
        console.print(f"written: {out}")
