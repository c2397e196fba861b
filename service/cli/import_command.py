"""`orthocapture import`: make a run of photographs, scan and CT that were captured earlier."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    console,
    error_console,
    print_json,
    print_table,
    progress_bar,
    protocol_file,
    reporting_errors,
    shipped_protocols,
)
from service.cli.ending import ExitStatus
from service.cli.operators import part_of
from service.cli.options import (
    OperatorOption,
    PasswordOption,
    PurposeOption,
    RemarksOption,
    SiteOption,
    SpecimenOption,
    acting_person,
    described,
)
from service.cli.run import WorkerOption, drive
from service.computations.evaluate import Row
from service.core.errors import ConfigurationError
from service.core.protocol import LoadedProtocol, Protocol, load_protocol
from service.core.records.entered import RunAbout
from service.core.records.import_list import FileRole, ImportList, PhotographRole
from service.core.units import megabytes
from service.dataset.registrations import shared_adjustment_note
from service.dataset.summary import summarise
from service.import_folder import CtReading, find_places, import_rig, list_import
from service.rig import Rig
from service.run_record import recorded_root
from service.run_start import start_run
from service.steps import params_models
from service.steps.protocol_check import require_plausible
from service.store.store import Store

_PROTOCOL = shipped_protocols() / "import_spine.yaml"
_SHOWN = 12  # most left-out files listed one by one
_PARTS: dict[PhotographRole, str] = {
    "calibration": "calibration images",
    "image": "images",
    "control_image": "control images",
}


def import_command(
    folder: Annotated[Path, typer.Argument(help="Folder with calibration/, images/, control/, scan/ and so on.")],
    protocol: Annotated[
        Path,
        typer.Option("--protocol", help="The protocol of the import.", show_default="the shipped import_spine.yaml"),
    ] = _PROTOCOL,
    calibration_images: Annotated[
        Path | None, typer.Option("--calibration-images", metavar="DIR", help="Images of the board.")
    ] = None,
    images: Annotated[Path | None, typer.Option("--images", metavar="DIR", help="Images of the data set.")] = None,
    control_images: Annotated[
        Path | None, typer.Option("--control-images", metavar="DIR", help="Images that show the control spheres.")
    ] = None,
    scan: Annotated[Path | None, typer.Option("--scan", help="The mesh, or a folder with only one mesh.")] = None,
    control_scan: Annotated[
        Path | None, typer.Option("--control-scan", help="The mesh that also shows the control spheres.")
    ] = None,
    ct: Annotated[Path | None, typer.Option("--ct", metavar="DIR", help="Folder of a DICOM series.")] = None,
    ct_first_number: Annotated[
        int,
        typer.Option("--ct-first-number", min=0, help="Number of the series' first slice, if it is not 1."),
    ] = 1,
    ct_series: Annotated[
        str,
        typer.Option("--ct-series", metavar="TEXT", help="A part of the series' description, if there are several."),
    ] = "",
    ct_unspecified_is_hounsfield: Annotated[
        bool,
        typer.Option(
            "--ct-unspecified-is-hounsfield",
            help="The series' values are Hounsfield units, though its files leave the unit open (rescale type US).",
        ),
    ] = False,
    simulated: Annotated[
        bool, typer.Option("--simulated", help="The files come from simulators; all results are marked accordingly.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show what would be imported, and import nothing.")
    ] = False,
    again: Annotated[bool, typer.Option("--again", help="Import the same files again as another run.")] = False,
    data: DataOption = DEFAULT_DATA,
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    worker: WorkerOption = True,
    specimen: SpecimenOption = "",
    purpose: PurposeOption = "",
    site: SiteOption = "",
    remarks: RemarksOption = "",
    json: JsonOption = False,
) -> None:
    """Import photographs, scan and CT that were captured earlier; register and evaluate them as a run.

    After an interruption, the same command continues the run.
    """
    given: dict[PhotographRole | FileRole, Path | None] = {
        "calibration": calibration_images,
        "image": images,
        "control_image": control_images,
        "scan": scan,
        "control_scan": control_scan,
        "ct": ct,
    }
    reading = CtReading(ct_first_number, ct_series, ct_unspecified_is_hounsfield)
    with reporting_errors(json):
        about = RunAbout() if dry_run else described(specimen, purpose=purpose, site=site, remarks=remarks)
        loaded = load_protocol(protocol_file(protocol), params_models())
        require_plausible(loaded, str(protocol))
        with progress_bar(quiet=json) as progress:
            places = find_places(folder, given, _parts_of(loaded.protocol))
            listing = list_import(places, progress, ct=reading)
        _require_wanted(loaded.protocol, listing)
        if not json:
            _show(listing)
        if dry_run:
            if json:
                print_json(listing_record(listing))
            return
        rig = import_rig(listing, simulated=simulated, ct=reading)
        with Store.open(data) as store:
            who = acting_person(store, operator, "operate", password_stdin=password_stdin)
            run_id = _run_of(store, loaded, rig, operator=who.name, again=again, about=about)
            state = drive(store, run_id, rig, data=data, auto_confirm=False, worker=worker, who=who)
            summary = summarise(store, run_id, loaded.protocol)
            table, note = summary.table(), shared_adjustment_note(loaded.protocol, summary.state)
        if json:
            rows = [row.plain() for row in table]
            answer = {"run": run_id, "status": state.status, "table": rows, "table_note": note}
            print_json({**answer, **listing_record(listing)})
        else:
            _show_result(run_id, state.status, len(state.deviations), table, note)
        if state.status != "completed":
            raise typer.Exit(ExitStatus.FAILED)


def _parts_of(protocol: Protocol) -> set[PhotographRole | FileRole]:
    """Return which photographs and files the steps of a protocol import."""
    parts: set[PhotographRole | FileRole] = set()
    for step in protocol.step_ids:
        part = part_of(protocol, step)
        if part is not None:
            parts.add(part)
    return parts


def _require_wanted(protocol: Protocol, listing: ImportList) -> None:
    """Raise ConfigurationError, before anything is recorded, if a part that the protocol needs is missing."""
    for step in protocol.steps:
        part = part_of(protocol, step.id)
        if part is not None and not step.skippable and not listing.holds(part):
            raise ConfigurationError(
                f"the protocol needs {part.replace('_', ' ')} (step {step.id!r}), and the folder holds none",
                where=listing.folder,
                remedy="Name it with its option (see --help), or use a protocol in which that step may be skipped",
            )


def _run_of(store: Store, loaded: LoadedProtocol, rig: Rig, *, operator: str, again: bool, about: RunAbout) -> str:
    """Return the unfinished run of exactly this list and protocol, or a new run.

    Raises ConfigurationError if the list was imported before, or if files of a simulated run are imported as real.
    """
    listing = hashlib.sha256(rig.source).hexdigest()
    ours = {file.sha256 for file in rig.section.imported.all_files()} if rig.section.imported is not None else set()
    unfinished = store.open_runs()
    for row in reversed(store.runs()):
        theirs = store.artefacts(row.run_id)
        root = recorded_root(store, row.run_id)
        if root.rig.sha256 == listing and root.protocol_sha256 == loaded.sha256 and not again:
            if row.run_id in unfinished:
                error_console.print(f"Continuing run {row.run_id}, which was interrupted.")
                return row.run_id
            raise ConfigurationError(
                f"these files were imported before: run {row.run_id}",
                where=str(store.database_path),
                remedy="Read that run, or import them as another run with --again",
            )
        if row.simulated and not rig.section.simulated and any(file.ref.sha256 in ours for file in theirs):
            raise ConfigurationError(
                f"files of this folder were made by simulators, in run {row.run_id}",
                where=str(rig.path.parent),
                remedy="Import them with --simulated, which marks the run",
            )
    return start_run(store, loaded, rig, operator=operator, auto_confirm=False, about=about)


# --- what is shown ----------------------------------------------------------------------------------------------


def listing_record(listing: ImportList) -> dict[str, object]:
    """Return the import list as plain data, for JSON output."""
    return {
        "folder": listing.folder,
        "photographs": {role: asdict(_photographs(listing, role)) for role in _PARTS if listing.holds(role)},
        "files": {role: [file.model_dump() for file in files] for role, files in listing.files.items()},
        "left_out": [one.model_dump() for one in listing.left_out],
        "unread": _unread(listing),
    }


def _unread(listing: ImportList) -> dict[str, str]:
    """Return by file what could not be read of photographs that are imported all the same."""
    return {v.photograph.path: v.optics.unread for v in listing.views if v.optics.unread}


@dataclass(frozen=True, slots=True)
class _PhotographsOfRole:
    """Counts, cameras, lenses, dates (EXIF; "" if missing) and sizes of the photographs with one role."""

    count: int
    raw_files: int
    cameras: list[str]
    lenses: list[str]
    focal_lengths_mm: list[float]
    sizes: list[str]
    first: str
    last: str
    bytes: int


def _photographs(listing: ImportList, role: PhotographRole) -> _PhotographsOfRole:
    views = listing.of(role)
    stated = [view.optics for view in views]
    times = sorted(optics.exif_time for optics in stated if optics.exif_time)
    return _PhotographsOfRole(
        count=len(views),
        raw_files=sum(len(view.raws) for view in views),
        cameras=_distinct((optics.make, optics.model, optics.body_serial) for optics in stated),
        lenses=_distinct((optics.lens, optics.lens_serial) for optics in stated),
        focal_lengths_mm=sorted({optics.focal_length_mm for optics in stated if optics.focal_length_mm is not None}),
        sizes=sorted({f"{optics.width} × {optics.height}" for optics in stated}),
        first=times[0] if times else "",
        last=times[-1] if times else "",
        bytes=sum(file.size_bytes for view in views for file in (view.photograph, *view.raws)),
    )


def _distinct(stated: Iterable[tuple[str, ...]]) -> list[str]:
    texts = (" ".join(filter(None, parts)) for parts in stated)
    return sorted({text or "not stated" for text in texts})


def _show(listing: ImportList) -> None:
    table = Table(title=f"Found in {listing.folder}", title_justify="left")
    for heading in ("what", "files", "camera and lens", "px", "taken, according to the files", "MB"):
        table.add_column(heading, justify="right" if heading in ("files", "MB") else "left")
    for role, words in _PARTS.items():
        if not listing.holds(role):
            continue
        found = _photographs(listing, role)
        raws = f" + {found.raw_files} raw" if found.raw_files else ""
        optics = "; ".join(dict.fromkeys([*found.cameras, *found.lenses]))
        dates = _dates(found.first, found.last)
        size = f"{megabytes(found.bytes):.1f}"
        table.add_row(words, f"{found.count}{raws}", optics, ", ".join(found.sizes), dates, size)
    for role, files in listing.files.items():
        size = f"{megabytes(sum(file.size_bytes for file in files)):.1f}"
        name = "DICOM series" if role == "ct" else Path(files[0].path).name
        written = f"written {files[0].modified_utc[:16].replace('T', ' ')}"
        table.add_row(role.replace("_", " "), str(len(files)), name, "", written, size)
    print_table(table)
    unread = _unread(listing)
    for path, what in list(unread.items())[:_SHOWN]:
        console.print(f"imported without what it states of camera and settings: {path}: {what}")
    if len(unread) > _SHOWN:
        console.print(f"imported in the same way: {len(unread) - _SHOWN} more files; --json lists them all")
    for one in listing.left_out[:_SHOWN]:
        console.print(f"left out: {one.path}: {one.reason}")
    if len(listing.left_out) > _SHOWN:
        console.print(f"left out: {len(listing.left_out) - _SHOWN} more files; --json lists them all")


def _dates(first: str, last: str) -> str:
    """Return the span between two EXIF times (`2024:03:01 10:14:00.000+00:00`), to the minute."""
    if not first:
        return "not stated"
    begin, end = (f"{text[:10].replace(':', '-')} {text[11:16]}" for text in (first, last))
    return begin if begin == end else f"{begin} to {end[11:] if end[:10] == begin[:10] else end}"


def _show_result(run_id: str, status: str, deviations: int, rows: Sequence[Row], note: str) -> None:
    if rows:
        table = Table(title="Registration error", title_justify="left")
        for heading in ("camera poses", "images", "evaluated on", "mean radial error (mm)", "reprojection (px)"):
            table.add_column(heading, justify="right" if "(" in heading else "left")
        for row in rows:
            table.add_row(
                row.poses,
                str(row.images),
                row.evaluated_on,
                f"{row.mean_radial_error_mm:.3f}",
                "–" if row.mean_reprojection_error_px is None else f"{row.mean_reprojection_error_px:.2f}",
            )
        print_table(table)
        if note:
            console.print(note)
    console.print(
        f"Run {run_id} is {status}; {deviations} deviations. Its photographs are imported: how they were captured is "
        "not in evidence."
    )
