"""`orthocapture develop`: raw files to linear TIFFs of 16 bits, with fixed parameters and a record beside each."""

from __future__ import annotations

import hashlib
import json as json_module
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from service.cli.common import JsonOption, console, print_json, reporting_errors, require_writable_folder, write_whole
from service.computations.further_cameras.compute import DevelopedFile, develop_file
from service.compute.photography import PARAMETERS
from service.core.errors import ConfigurationError, DataError

_JPEGS = (".jpg", ".jpeg")


def develop_command(
    files: Annotated[list[Path], typer.Argument(help="Raw files that LibRaw reads: ARW, CR3, NEF, DNG.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the TIFFs and their records.", file_okay=False)],
    demosaic: Annotated[
        str, typer.Option("--demosaic", help="LibRaw's algorithm, as rawpy names it.")
    ] = PARAMETERS.demosaic,
    json: JsonOption = False,
) -> None:
    """Develop raw files to linear TIFFs of 16 bits, always in the same way; needs the extra `raw`.

    A JPEG of the same name beside a raw file gives the picture its size, and its place is checked against it.
    """
    with reporting_errors(json):
        _require_new(files, out)
        records: list[dict[str, Any]] = []
        for file in files:
            jpeg = _jpeg_of(file)
            parameters = replace(PARAMETERS, demosaic=demosaic)
            made = develop_file(file, jpeg, parameters)
            records.append(_write(made, file, jpeg, out))
            if not json:
                _tell(records[-1], jpeg)
        if json:
            print_json(records)


def _require_new(files: list[Path], out: Path) -> None:
    """Require that nothing is overwritten, and that every raw file has a name of its own."""
    require_writable_folder(out)
    stems = [file.stem for file in files]
    twice = next((stem for stem in stems if stems.count(stem) > 1), None)
    if twice is not None:
        raise ConfigurationError(f"two raw files are called {twice}", where=str(out), remedy="Use a folder for each")
    there = next((path for stem in stems if (path := out / f"{stem}.tif").exists()), None)
    if there is not None:
        raise ConfigurationError("the file exists", where=str(there), remedy="Name another folder with --out")


def _jpeg_of(raw: Path) -> Path | None:
    """Return the JPEG of the same name, if there is one."""
    if not raw.is_file():
        raise DataError("the file does not exist", where=str(raw), remedy="Check the path")
    beside = (path for path in raw.parent.iterdir() if path.stem == raw.stem and path.suffix.lower() in _JPEGS)
    return min(beside, default=None)


def _write(made: DevelopedFile, raw: Path, jpeg: Path | None, out: Path) -> dict[str, Any]:
    out.mkdir(exist_ok=True)
    write_whole(out / f"{raw.stem}.tif", made.tiff)
    record: dict[str, Any] = {
        "raw": _named(raw.name, raw.read_bytes()),
        "jpeg": None if jpeg is None else _named(jpeg.name, jpeg.read_bytes()),
        "tiff": _named(f"{raw.stem}.tif", made.tiff),
        **asdict(made.how),
    }
    write_whole(out / f"{raw.stem}.json", json_module.dumps(record, indent=1) + "\n")
    return record


def _named(name: str, data: bytes) -> dict[str, str]:
    return {"name": name, "sha256": hashlib.sha256(data).hexdigest()}


def _tell(record: dict[str, Any], jpeg: Path | None) -> None:
    crop, shift_px = record["crop"], record["largest_shift_px"]
    place = "no JPEG beside it: its place is not checked"
    if jpeg is not None:
        place = f"at most {shift_px:.2f} px from {jpeg.name}"
    console.print(f"{record['tiff']['name']}: {crop['width']} × {crop['height']} px, {place}")
