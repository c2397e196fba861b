"""Photograph files of any camera: their EXIF, and whether a JPEG is whole."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import exiv2

from drivers.errors import UnreadableFileError
from drivers.interfaces import CameraSettings

_SOI, _EOI, _SOS = 0xD8, 0xD9, 0xDA
_STANDALONE = {0x01, *range(0xD0, 0xD8)}


@dataclass(frozen=True, slots=True)
class ExifRecord:
    """What a photograph says of itself; None or "" where the file does not say it."""

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
    orientation: int  # 1 when absent
    width: int
    height: int

    def settings(self, *, focus_mode: str, image_quality: str) -> CameraSettings:
        """Aperture, time and ISO of the file with two settings that EXIF has no standard tag for.

        Raises UnreadableFileError when one of the three is missing.
        """
        if self.aperture_f is None or self.exposure_s is None or self.iso is None:
            raise UnreadableFileError(
                "The photograph does not state aperture, exposure time and ISO",
                where=str(self.path),
                remedy="Use files as they left the camera; editing programs often remove EXIF",
            )
        return CameraSettings(self.aperture_f, self.exposure_s, self.iso, focus_mode, image_quality)


def read_exif(path: Path) -> ExifRecord:
    """Read the EXIF of a photograph (JPEG, TIFF, PNG, raw). Raises UnreadableFileError if it is no picture at all."""
    try:
        image = exiv2.ImageFactory.open(str(path))
        image.readMetadata()
    except exiv2.Exiv2Error as error:
        raise UnreadableFileError(
            f"The photograph cannot be read: {error}", where=str(path), remedy="Copy it again from the camera"
        ) from error
    exif = image.exifData()
    return ExifRecord(
        path=path,
        make=_text(exiv2.make(exif), exif),
        model=_text(exiv2.model(exif), exif),
        body_serial=_text(exiv2.serialNumber(exif), exif),
        lens=_text(exiv2.lensName(exif), exif),
        aperture_f=_number(exiv2.fNumber(exif), exif),
        exposure_s=_number(exiv2.exposureTime(exif), exif),
        iso=_integer(exiv2.isoSpeed(exif), exif),
        focal_length_mm=_number(exiv2.focalLength(exif), exif),
        taken=_taken(exif),
        orientation=_integer(exiv2.orientation(exif), exif) or 1,
        width=int(image.pixelWidth()),
        height=int(image.pixelHeight()),
    )


def _text(found: Any, exif: Any) -> str:
    return "" if found == exif.end() else str(found.print(exif)).strip()


def _number(found: Any, exif: Any) -> float | None:
    if found == exif.end() or found.count() == 0:
        return None
    numerator, denominator = found.toRational()
    # Cameras write 0/0 for a lens that does not report.
    return numerator / denominator if denominator and numerator > 0 else None


def _integer(found: Any, exif: Any) -> int | None:
    return None if found == exif.end() or found.count() == 0 else int(found.toInt64())


def _taken(exif: Any) -> str:
    parts: list[str] = []
    for key, prefix in (("DateTimeOriginal", ""), ("SubSecTimeOriginal", "."), ("OffsetTimeOriginal", "")):
        found = exif.findKey(exiv2.ExifKey(f"Exif.Photo.{key}"))
        value = "" if found == exif.end() else str(found.toString()).strip()
        if not value and not parts:
            return ""
        parts.append(f"{prefix}{value}" if value else "")
    return "".join(parts)


def check_jpeg_complete(path: Path) -> None:
    """Raise UnreadableFileError unless the file is a JPEG whose picture has its end marker.

    Data after the first picture (the previews that Sony appends) are allowed. Inside compressed data FF D9 can only be
    the end marker (ITU T.81, B.1.1.2), so a search after the first scan header decides.
    """
    data = path.read_bytes()
    if data[:2] != bytes((0xFF, _SOI)):
        raise _incomplete(path, "does not begin as a JPEG", len(data))
    position = 2
    while position + 4 <= len(data):
        if data[position] != 0xFF:
            break
        marker = data[position + 1]
        if marker == 0xFF:
            position += 1
        elif marker in _STANDALONE:
            position += 2
        elif marker == _SOS:
            if data.find(bytes((0xFF, _EOI)), position) < 0:
                break
            return
        else:
            position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    raise _incomplete(path, "is cut off: its end marker is missing", len(data))


def _incomplete(path: Path, what: str, size_bytes: int) -> UnreadableFileError:
    return UnreadableFileError(
        f"{path.name} ({size_bytes} bytes) {what}",
        where=str(path),
        remedy="Take this exposure again; the files recorded before it are not affected",
    )


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
