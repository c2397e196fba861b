"""Photograph files of any camera: reads their EXIF and checks that a JPEG is complete."""

from __future__ import annotations

import hashlib
import importlib
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from drivers.errors import UnreadableFileError
from drivers.foreign_code import check_name, reading
from drivers.interfaces import CameraSettings, CapturedFile, CapturedImage
from service.core.errors import DataError
from service.core.picture_files import ForeignKindError, TruncatedPictureError, check_jpeg, kind_of, picture_size

# The library has no types; see docs/decisions/0002-strict-typing.md.
exiv2: Any = importlib.import_module("exiv2")
_TEXTS = (exiv2.TypeId.asciiString, exiv2.TypeId.undefined)  # kinds of values that are no numbers
_LONGEST_TEXT = 500  # limit for a name or a time; cameras write less than a tenth of it


@dataclass(frozen=True, slots=True)
class ExifRecord:
    """The EXIF data of a photograph; None or "" if the file does not state a value."""

    path: Path
    make: str
    model: str
    body_serial: str
    lens: str
    aperture_f: float | None
    exposure_s: float | None
    iso: int | None
    focal_length_mm: float | None
    taken: str  # DateTimeOriginal[.subseconds][offset], "2026:11:21 04:39:03.482+01:00"
    orientation: int  # 1 if absent
    width: int
    height: int
    lens_serial: str = ""
    focus_distance_m: float | None = None  # many lenses do not report it
    focus_mode: str = ""  # in the manufacturer's words
    focus_position: int | None = None  # of the lens's focus motor, in its own steps, if the camera reports it
    unread: str = ""  # why the file's EXIF, which is broken, could not be read

    def settings(self, *, focus_mode: str, image_quality: str) -> CameraSettings:
        """Combine aperture, exposure time and ISO of the file with two settings that have no standard EXIF tag.

        Raises UnreadableFileError if one of the three is missing.
        """
        if self.aperture_f is None or self.exposure_s is None or self.iso is None:
            raise UnreadableFileError(
                self.unread or "the photograph does not state aperture, exposure time and ISO",
                where=str(self.path),
                remedy="Use files as they left the camera; editing programs often remove EXIF",
            )
        return CameraSettings(self.aperture_f, self.exposure_s, self.iso, focus_mode, image_quality)

    def exposure_of(
        self,
        files: tuple[CapturedFile, ...],
        counter: int,
        settings: CameraSettings,
        *,
        trigger_monotonic_s: float,
        arrival_monotonic_s: float,
        found_at: str = "",
    ) -> CapturedImage:
        """The exposure that these files are, with what its EXIF data states."""
        return CapturedImage(
            files=files,
            counter=counter,
            exif_time=self.taken,
            exif=settings,
            lens=self.lens,
            focal_length_mm=self.focal_length_mm or 0.0,
            trigger_monotonic_s=trigger_monotonic_s,
            arrival_monotonic_s=arrival_monotonic_s,
            width=self.width,
            height=self.height,
            lens_serial=self.lens_serial,
            body_serial=self.body_serial,
            model=self.model,
            focus_distance_m=self.focus_distance_m or 0.0,
            focus_position=self.focus_position,
            found_at=found_at,
        )


# The library's own look-up functions crash the process on images without EXIF, so keys are looked up by name.
_KEYS = {
    "make": ("Exif.Image.Make",),
    "model": ("Exif.Image.Model", "Exif.Image.UniqueCameraModel"),
    "serial": ("Exif.Photo.BodySerialNumber", "Exif.Image.CameraSerialNumber"),
    "lens": ("Exif.Photo.LensModel",),
    "lens_serial": ("Exif.Photo.LensSerialNumber",),
    "focus_distance": ("Exif.Photo.SubjectDistance", "Exif.Image.SubjectDistance"),
    "focus_position": ("Exif.Sony2Fp.FocusPosition2",),
    "focus_mode": (
        "Exif.Sony2Fp.FocusMode",
        "Exif.Sony1.FocusMode",
        "Exif.Sony2.FocusMode",
        "Exif.Nikon3.Focus",
        "Exif.CanonCs.FocusMode",
        "Exif.Fujifilm.FocusMode",
        "Exif.Panasonic.FocusMode",
    ),
    "aperture": ("Exif.Photo.FNumber", "Exif.Image.FNumber"),
    "exposure": ("Exif.Photo.ExposureTime", "Exif.Image.ExposureTime"),
    "iso": ("Exif.Photo.ISOSpeedRatings", "Exif.Image.ISOSpeedRatings", "Exif.Photo.RecommendedExposureIndex"),
    "focal_length": ("Exif.Photo.FocalLength", "Exif.Image.FocalLength"),
    "orientation": ("Exif.Image.Orientation",),
    "taken": ("Exif.Photo.DateTimeOriginal", "Exif.Image.DateTimeOriginal"),
    "subseconds": ("Exif.Photo.SubSecTimeOriginal",),
    "offset": ("Exif.Photo.OffsetTimeOriginal",),
}


def read_exif(path: Path) -> ExifRecord:
    """Read the EXIF of a photograph (JPEG, TIFF, PNG, raw).

    A JPEG whose EXIF is broken states nothing but its size, and `unread` says why.

    Raises UnreadableFileError if the file is not an image.
    """
    check_name(path)
    size = _jpeg_size(path)
    try:
        with reading(path, "a photograph", "Copy it again from the camera"):
            return _read_record(path, size)
    except UnreadableFileError as error:
        if size is None:
            raise
        width, height = size
        return ExifRecord(
            path, "", "", "", "", None, None, None, None, "", 1, width, height,
            unread=f"the photograph's EXIF is broken: {error.__cause__}",
        )  # fmt: skip


def _read_record(path: Path, size: tuple[int, int] | None) -> ExifRecord:
    image = exiv2.ImageFactory.open(str(path))
    image.readMetadata()
    exif = image.exifData()
    # The library takes the size from what it has read of a JPEG, which a broken colour profile cuts short.
    width, height = size or (int(image.pixelWidth()), int(image.pixelHeight()))
    return ExifRecord(
        path=path,
        make=_text(exif, "make"),
        model=_text(exif, "model"),
        body_serial=_text(exif, "serial"),
        lens=_text(exif, "lens"),
        aperture_f=_number(exif, "aperture"),
        exposure_s=_number(exif, "exposure"),
        iso=_integer(exif, "iso"),
        focal_length_mm=_number(exif, "focal_length"),
        taken=_time_taken(exif),
        orientation=_integer(exif, "orientation") or 1,
        width=width,
        height=height,
        lens_serial=_text(exif, "lens_serial"),
        focus_distance_m=_number(exif, "focus_distance"),
        focus_mode=_text(exif, "focus_mode", in_words=True),
        focus_position=_integer(exif, "focus_position"),
    )


def _jpeg_size(path: Path) -> tuple[int, int] | None:
    """Width and height by a JPEG's own header; None for other files."""
    if kind_of_file(path) != "JPEG":
        return None
    try:
        return picture_size(path.read_bytes(), str(path))
    except DataError:
        return None


def _find(exif: Any, name: str) -> Any:
    for key in _KEYS[name]:
        if key in exif and exif[key].count() > 0:
            return exif[key]
    return None


def _text(exif: Any, name: str, *, in_words: bool = False) -> str:
    found = _find(exif, name)
    if found is None:
        return ""
    # The text can be any bytes; exiv2 returns invalid UTF-8 as lone surrogates, which cannot be encoded again.
    words = (
        str(found.print() if in_words else found.toString())
        .encode("utf-8", "surrogateescape")
        .decode("utf-8", "replace")
    )
    return words[:_LONGEST_TEXT].replace("\0", " ").strip()


def _number(exif: Any, name: str) -> float | None:
    found = _find(exif, name)
    if found is None:
        return None
    if found.typeId() in _TEXTS:
        return None  # the library would give the code of its first letter
    numerator, denominator = found.toRational()
    # Cameras write 0/0 if the lens reports no value.
    return numerator / denominator if denominator and numerator > 0 else None


def _integer(exif: Any, name: str) -> int | None:
    found = _find(exif, name)
    return None if found is None or found.typeId() in _TEXTS else int(found.toInt64())


def _time_taken(exif: Any) -> str:
    moment, subseconds = _text(exif, "taken"), _text(exif, "subseconds")
    if not moment:
        return ""
    return moment + (f".{subseconds}" if subseconds else "") + _text(exif, "offset")


def taken_utc_s(taken: str) -> float | None:
    """Parse an EXIF time (ExifRecord.taken) into seconds since 1970; None if it is not a valid time.

    A time without a UTC offset is taken as this computer's local time, because people set cameras to local time.
    """
    for form in ("%Y:%m:%d %H:%M:%S.%f%z", "%Y:%m:%d %H:%M:%S%z", "%Y:%m:%d %H:%M:%S.%f", "%Y:%m:%d %H:%M:%S"):
        try:
            return datetime.strptime(taken, form).astimezone().timestamp()
        except ValueError:
            continue
    return None


def check_jpeg_complete(path: Path) -> None:
    """Raise UnreadableFileError unless the file is a JPEG whose image has its end marker.

    Data after the first image (the previews that Sony appends) is allowed.
    """
    data = path.read_bytes()
    try:
        check_jpeg(data, str(path))
    except TruncatedPictureError as error:
        raise _incomplete(path, "is cut off: its end marker is missing", len(data)) from error
    except ForeignKindError as error:
        raise UnreadableFileError(error.what, where=str(path), remedy=error.remedy) from error
    except DataError as error:
        raise _incomplete(path, f"cannot be used: {error.what}", len(data)) from error


def kind_of_file(path: Path) -> str:
    """What a file is by its first bytes, as `service.core.picture_files.kind_of`; "" too if it cannot be opened."""
    try:
        with path.open("rb") as stream:
            return kind_of(stream.read(64))
    except OSError:
        return ""


def _incomplete(path: Path, what: str, size_bytes: int) -> UnreadableFileError:
    return UnreadableFileError(
        f"{path.name} ({size_bytes} bytes) {what}",
        where=str(path),
        remedy="Take this exposure again; the files recorded before it are not affected",
    )


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
