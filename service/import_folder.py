"""List a folder of photographs, scan and CT captured earlier for an import, and make the rig that stands for it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from drivers.errors import IncompleteExportError, UnreadableFileError
from drivers.folder_files import files_below
from drivers.foreign_code import check_name
from drivers.meshes.mesh_file import MESH_SUFFIXES, export_of
from drivers.photos.photo_file import ExifRecord
from drivers.photos.photo_folder import (
    RAW_MEDIA_TYPES,
    LeftOut,
    ListedFile,
    Photograph,
    list_photographs,
    listed,
    odd,
    of_size,
    usual_size,
    without_duplicates,
)
from service.core.errors import DataError
from service.core.records.import_list import (
    FileRole,
    ImportedFile,
    ImportedView,
    ImportList,
    LeftOutFile,
    PhotographRole,
)
from service.core.units import seconds_of_ns
from service.rig import Rig, RigSection
from service.station import Station

#: Names of subfolders, in lower case, in which each part is searched for unless an option names another place.
FOLDERS: dict[PhotographRole | FileRole, tuple[str, ...]] = {
    "calibration": ("calibration", "calibration_images", "calib", "board"),
    "image": ("images", "photographs", "photos"),
    "control_image": ("control", "control_images"),
    "scan": ("scan", "scans", "mesh"),
    "control_scan": ("control_scan", "control_scans"),
    "ct": ("ct", "dicom"),
}
# A photograph found in several parts counts once, in the first of these.
_PHOTOGRAPHS: tuple[PhotographRole, ...] = ("calibration", "control_image", "image")
_NEEDED: tuple[PhotographRole, ...] = ("calibration", "image")
_SCANS: tuple[FileRole, ...] = ("scan", "control_scan")
_NAMED = 8  # most damaged files named in an error
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class ImportFolders:
    """The folder of each part of an import; for scans also a file. None if there is no such part."""

    folder: Path
    calibration: Path | None = None
    image: Path | None = None
    control_image: Path | None = None
    scan: Path | None = None
    control_scan: Path | None = None
    ct: Path | None = None


def find_places(
    folder: Path, given: Mapping[PhotographRole | FileRole, Path | None], wanted: Set[PhotographRole | FileRole]
) -> ImportFolders:
    """Return the places of the wanted parts: those given, else subfolders with one of the names in FOLDERS.

    Raises DataError if the folder or a given place does not exist, or if a part is given that is not wanted.
    """
    if not folder.is_dir():
        raise DataError("the folder does not exist", where=str(folder))
    below = {path.name.lower(): path for path in sorted(folder.iterdir()) if path.is_dir()}
    found: dict[str, Path] = {}
    for role, names in FOLDERS.items():
        named = given.get(role)
        if named is not None and not named.exists():
            raise DataError(f"there is no such place for {_words(role)}", where=str(named))
        if role not in wanted:
            if named is not None:
                raise DataError(f"no step of the protocol imports {_words(role)}", where=str(named))
            continue
        place = named or next((below[name] for name in names if name in below), None)
        if place is not None:
            found[role] = place.resolve()
    return ImportFolders(folder.resolve(), **found)


@dataclass(frozen=True, slots=True)
class CtReading:
    """The settings that a rig.yaml would have for the CT series.

    Attributes:
        first_number: the number of the first slice of a whole series.
        series: a part of the description of the series to use, where there are several.
        unspecified_is_hounsfield: true if values of a series without a unit are Hounsfield units.
    """

    first_number: int = 1
    series: str = ""
    unspecified_is_hounsfield: bool = False

    def device(self, folder: Path) -> dict[str, Any]:
        """Return the section of the device that reads a folder so."""
        given = {one.name: value for one in fields(self) if (value := getattr(self, one.name)) != one.default}
        return {"driver": "dicom_folder", "folder": str(folder), "stable_s": 0, **given}


def list_import(
    places: ImportFolders,
    progress: Progress = lambda _what, _done, _total: None,
    *,
    ct: CtReading | None = None,
) -> ImportList:
    """Return every file to be imported, with its hash, and the files left out, with the reasons.

    Raises:
        DataError: photographs are damaged or missing, or there is not exactly one complete scan or CT series.
        DeviceUnavailableError: a folder cannot be read.
    """
    views, left_out = _views(places, progress)
    files: dict[FileRole, tuple[ImportedFile, ...]] = {}
    scans: dict[FileRole, Path | None] = {"scan": places.scan, "control_scan": places.control_scan}
    for role, place in scans.items():
        if place is not None:
            export, others = _scan(place, role)
            files[role] = tuple(_file(listed(path), places) for path in export)
            left_out += others
    if places.ct is not None:
        progress("CT", 0, 1)
        series, others = _ct(places.ct, ct or CtReading())
        files["ct"] = tuple(_file(listed(path), places, "application/dicom") for path in series)
        left_out += others
    left_out += _elsewhere(places)
    return ImportList(
        folder=str(places.folder),
        views=tuple(views),
        files=files,
        left_out=tuple(LeftOutFile(path=_shown(one.path, places), reason=one.reason) for one in left_out),
    )


def import_rig(listing: ImportList, *, simulated: bool, ct: CtReading | None = None) -> Rig:
    """Return the rig of an import's run: the list, with the folders of scan and CT as devices."""
    devices: dict[str, dict[str, Any]] = {}
    for role in _SCANS:
        if listing.holds(role):
            path = Path(listing.absolute(listing.files[role][0]))
            devices[role] = {"driver": "scan_folder", "folder": str(path.parent), "only": path.name, "stable_s": 0}
    if listing.holds("ct"):
        folders = {Path(listing.absolute(file)).parent for file in listing.files["ct"]}
        common = min(folders, key=lambda folder: len(folder.parts))
        devices["ct"] = (ct or CtReading()).device(common)
    section = RigSection(
        name=f"import of {Path(listing.folder).name}", simulated=simulated, devices=devices, imported=listing
    )
    data = section.model_dump(mode="json", exclude_defaults=True)
    source = json.dumps(data, indent=1, sort_keys=True, ensure_ascii=False).encode()
    return Rig(section, Path(listing.folder) / "import-list.json", source)


# --- photographs ------------------------------------------------------------------------------------------------


def _views(places: ImportFolders, progress: Progress) -> tuple[list[ImportedView], list[LeftOut]]:
    left_out: list[LeftOut] = []
    damaged: list[LeftOut] = []
    seen: dict[str, Path] = {}
    kept: dict[PhotographRole, list[Photograph]] = {}
    for number, role in enumerate(_PHOTOGRAPHS):
        progress("photographs", number, len(_PHOTOGRAPHS))
        place: Path | None = getattr(places, role)
        if place is None:
            continue
        found = list_photographs(place)
        once, again = without_duplicates(found.photographs, seen)
        kept[role] = once
        left_out += [*found.left_out, *again]
        damaged += found.damaged
    if damaged:
        raise _damaged(damaged, places)
    size = usual_size(photograph for photographs in kept.values() for photograph in photographs)
    for role, photographs in kept.items():
        if size is not None:
            kept[role], others = of_size(photographs, size)
            left_out += others
    for role in _NEEDED:
        if not kept.get(role):
            raise _none(role, places, left_out)
    names = _names([(role, p.file.path) for role in kept for p in kept[role]], places)
    views = [
        ImportedView(
            name=names[p.file.path],
            role=role,
            photograph=_file(p.file, places, "image/jpeg"),
            raws=tuple(_file(raw, places, RAW_MEDIA_TYPES[raw.path.suffix.lower()]) for raw in p.raws),
            camera=camera_record(p.exif),
        )
        for role in kept
        for p in kept[role]
    ]
    return views, left_out


def camera_record(exif: ExifRecord) -> dict[str, Any]:
    """Return camera, lens and settings given in a photograph's EXIF, with the keys used in capture events."""
    stated: dict[str, Any] = {
        "make": exif.make,
        "model": exif.model,
        "body_serial": exif.body_serial,
        "lens": exif.lens,
        "lens_serial": exif.lens_serial,
        "aperture_f": exif.aperture_f,
        "exposure_s": exif.exposure_s,
        "iso": exif.iso,
        "focal_length_mm": exif.focal_length_mm,
        "focus_distance_m": exif.focus_distance_m,
        "focus_mode": exif.focus_mode,
        "focus_position": exif.focus_position,
        "exif_time": exif.taken,
        "width": exif.width,
        "height": exif.height,
        "unread": exif.unread,
    }
    return {name: value for name, value in stated.items() if value not in (None, "")}


def _names(photographs: Sequence[tuple[PhotographRole, Path]], places: ImportFolders) -> dict[Path, str]:
    """Return a name for each view: the file's stem, with its folders in front if several files have the same stem."""
    stems = [_plain(path.stem) for _, path in photographs]
    names: dict[Path, str] = {}
    taken: set[str] = set()
    for (role, path), stem in zip(photographs, stems, strict=True):
        place: Path = getattr(places, role)
        inside = "_".join((role, *path.relative_to(place).parent.parts, path.stem))
        name = stem if stems.count(stem) == 1 else _plain(inside)
        number = 1
        while name in taken:
            number += 1
            name = f"{_plain(inside)}-{number}"
        taken.add(name)
        names[path] = name
    return names


def _plain(text: str) -> str:
    """Return a valid name of a view: letters, digits and `_.-+`; the last 56 characters, where cameras count."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "_.-+") else "_" for c in text)[-56:]


def _damaged(damaged: Sequence[LeftOut], places: ImportFolders) -> DataError:
    shown = "; ".join(f"{_shown(one.path, places)}: {one.reason}" for one in damaged[:_NAMED])
    more = f"; and {len(damaged) - _NAMED} more" if len(damaged) > _NAMED else ""
    return DataError(
        f"{len(damaged)} photographs are damaged: {shown}{more}",
        where=str(places.folder),
        remedy="Copy them again from the camera or its card, or remove them from the folder",
    )


def _none(role: PhotographRole, places: ImportFolders, left_out: Sequence[LeftOut]) -> DataError:
    place: Path | None = getattr(places, role)
    option = "--calibration-images" if role == "calibration" else "--images"
    if place is None:
        return DataError(
            f"no folder of {_words(role)}",
            where=str(places.folder),
            remedy=f"Put them into {places.folder.name}/{FOLDERS[role][0]}, or name their folder with {option}",
        )
    mine = [one for one in left_out if one.path.is_relative_to(place)]
    why = f"; left out: {mine[0].path.name} ({mine[0].reason}){' and others' * (len(mine) > 1)}" if mine else ""
    return DataError(f"no usable photograph{why}", where=str(place), remedy="Check the files there")


# --- scan and CT ------------------------------------------------------------------------------------------------


def _scan(place: Path, role: str) -> tuple[tuple[Path, ...], list[LeftOut]]:
    """Return the files of a mesh, given as a file or as a folder with only one mesh, and the other files there."""
    option = f"--{role.replace('_', '-')}"
    if place.is_file():
        meshes, others = [place], []
    else:
        files = files_below(place)
        meshes = [path for path in files if path.suffix.lower() in MESH_SUFFIXES and not odd(path, place)]
        others = [path for path in files if path not in meshes]
    if len(meshes) != 1:
        what = f"{len(meshes)} meshes: {', '.join(path.name for path in meshes)}" if meshes else "no mesh"
        raise DataError(
            f"{what} (OBJ, PLY or STL)", where=str(place), remedy=f"Name the file of the scan with {option}"
        )
    try:
        export = export_of(meshes[0]).files
        for path in export:
            check_name(path)
    except (IncompleteExportError, UnreadableFileError) as error:
        raise DataError(error.what, where=error.where, remedy=error.remedy) from error
    left_out = [LeftOut(path, odd(path, place) or "no part of the scan") for path in others if path not in export]
    return export, left_out


def _ct(folder: Path, reading: CtReading) -> tuple[tuple[Path, ...], list[LeftOut]]:
    """Return the slices of the only complete series in a folder, and the other files there."""
    section = RigSection(name="CT", devices={"ct": reading.device(folder)})
    station = Station(Rig(section, folder / "import-list.json", b""))
    try:
        ct = station.ct()
        found = ct.series()
        problems = ct.report().problems
    finally:
        station.close()
    sound = [series for series in found if not series.problems and series.slices > 1]
    if len(sound) != 1:
        what = f"no complete CT series ({'; '.join(problems) or 'no DICOM file'})"
        if sound:
            names = "; ".join(one.description or one.uid for one in sound)
            what = f"{len(sound)} CT series: {names}"
        remedy = (
            "Name the folder of one complete series with --ct, or a part of its description with --ct-series. What a "
            "rig.yaml would say of it, say with --ct-first-number and --ct-unspecified-is-hounsfield"
        )
        raise DataError(what, where=str(folder), remedy=remedy)
    chosen = set(sound[0].files)
    others = [path for path in files_below(folder) if path not in chosen]
    return sound[0].files, [LeftOut(path, odd(path, folder) or "no slice of the series") for path in others]


def _elsewhere(places: ImportFolders) -> list[LeftOut]:
    """Return the files of the folder that are in none of its parts."""
    parts = [
        place
        for place in (
            places.calibration, places.image, places.control_image, places.scan, places.control_scan, places.ct
        )
        if place is not None
    ]  # fmt: skip
    rest = [path for path in files_below(places.folder) if not any(path.is_relative_to(part) for part in parts)]
    beside = {path for part in parts if part.is_file() for path in _companions(part)}
    return [
        LeftOut(path, odd(path, places.folder) or "in none of the folders that are imported")
        for path in rest
        if path not in beside
    ]


def _companions(mesh: Path) -> Iterable[Path]:
    return export_of(mesh).files


# --- texts and records ------------------------------------------------------------------------------------------


def _file(file: ListedFile, places: ImportFolders, media_type: str = "application/octet-stream") -> ImportedFile:
    return ImportedFile(
        path=_shown(file.path, places),
        sha256=file.sha256,
        size_bytes=file.size_bytes,
        modified_utc=datetime.fromtimestamp(seconds_of_ns(file.modified_ns), UTC).isoformat(timespec="seconds"),
        media_type=media_type,
    )


def _shown(path: Path, places: ImportFolders) -> str:
    """Return a path relative to the import's folder, or absolute if outside it."""
    return str(path.relative_to(places.folder) if path.is_relative_to(places.folder) else path)


def _words(role: str) -> str:
    return {"calibration": "calibration images", "image": "images", "control_image": "control images"}.get(
        role, role.replace("_", " ")
    )
