"""Picture files as bytes: which kind they are, whatever their name says, whether they are whole, and their size."""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator

from service.core.errors import DataError

JPEG_BEGINS = b"\xff\xd8"
PNG_BEGINS = b"\x89PNG\r\n\x1a\n"
MOST_PIXELS = 400_000_000  # three times the largest cameras; a damaged header may claim up to four gigabytes

# In entropy-coded data 0xFF is followed by 0x00 (stuffing) or a restart marker; anything else ends the scan
# (ITU-T T.81, B.1.1.5).
_END_OF_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_FILL, _START_OF_SCAN, _END_OF_IMAGE = 0xFF, 0xDA, 0xD9
_STANDALONE = {0x01, *range(0xD0, 0xD8)}  # markers without a length
_METADATA = {0xE1, 0xED, 0xFE}  # EXIF and XMP, IPTC, comments
_FRAMES = {0xC0, 0xC1, 0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF}  # headers with the size


# Brands of ISO base media files, the most telling first.
_BRANDS = (
    ("AVIF", {b"avif", b"avis"}),
    ("HEIC", {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"}),
    ("raw file", {b"crx "}),
)
# What files begin with.
_KINDS = (
    (JPEG_BEGINS, "JPEG"),
    (PNG_BEGINS, "PNG"),
    (b"GIF8", "GIF"),
    (b"II*\0", "TIFF"),
    (b"MM\0*", "TIFF"),
    (b"II+\0", "TIFF"),
    (b"MM\0+", "TIFF"),
    (b"BM", "BMP"),
    (b"\0\0\0\x0cjP  \r\n\x87\n", "JPEG 2000"),
    (b"\xff\x4f\xff\x51", "JPEG 2000"),
    (b"\0\0\0\x0cJXL \r\n\x87\n", "JPEG XL"),
    (b"\xff\x0a", "JPEG XL"),
    (b"8BPS", "Photoshop"),
    (b"\x76\x2f\x31\x01", "OpenEXR"),
    (b"%PDF", "PDF"),
    (b"PK\3\4", "ZIP"),
    (b"\x1aE\xdf\xa3", "video"),
    (b"version https://git-lfs", "Git LFS pointer"),
)
_NO_PICTURES = {"PDF", "ZIP", "video", "text", "Git LFS pointer", "raw file", "Photoshop"}
_TEXT_BEGINS = (b"<!doctype html", b"<html", b"<?xml", b"{")


class TruncatedPictureError(DataError):
    """A file ends before its picture does."""


class ForeignKindError(DataError):
    """A file is whole, as far as can be seen, but of another kind than can be read."""


def kind_of(data: bytes) -> str:
    """Return a file's kind by its first bytes: JPEG, PNG, WebP, HEIC, …; "" if it is not known."""
    if data[:4] == b"RIFF":
        return {b"WEBP": "WebP", b"AVI ": "video"}.get(data[8:12], "")
    if data[4:8] == b"ftyp":
        brands = {data[at : at + 4] for at in (8, *range(16, min(int.from_bytes(data[:4], "big"), 64), 4))}
        return next((kind for kind, named in _BRANDS if brands & named), "video")
    if data[:1] == b"P" and data[1:2] in b"1234567" and data[2:3].isspace():
        return "PNM"
    if data[:64].lstrip(b"\xef\xbb\xbf \t\r\n").lower().startswith(_TEXT_BEGINS):
        return "text"
    return next((kind for begins, kind in _KINDS if data.startswith(begins)), "")


def another_kind(kind: str, wanted: str, where: str) -> ForeignKindError:
    """Return the error for a file of this kind, as `kind_of` names it, where only the wanted ones are read."""
    return ForeignKindError(
        f"this is {_article(kind)} {kind}{'' if kind in _NO_PICTURES else ' picture'}, not {wanted}",
        where=where,
        remedy=f"Save it as {wanted}, at its full size and without turning it"
        if kind not in _NO_PICTURES
        else "Copy the picture itself",
    )


def _article(kind: str) -> str:
    return "an" if kind in {"AVIF", "OpenEXR"} else "a"


def check_jpeg(data: bytes, where: str) -> None:
    """Check that a JPEG is complete, by walking its segments up to the end-of-image marker.

    Data after that marker (previews that cameras append) is allowed.

    Raises:
        ForeignKindError: the file is of another kind, which the error names.
        TruncatedPictureError: the file ends before its picture does.
        DataError: the file is not a JPEG, is damaged, or claims more pixels than any camera has.
    """
    kind = kind_of(data)
    if kind not in {"JPEG", ""}:
        raise another_kind(kind, "JPEG", where)
    if not kind:
        raise DataError("this is not a JPEG file", where=where, remedy="Use JPEG or PNG images")
    for marker, at in _segments(data, where):
        if marker == _END_OF_IMAGE:
            return
        if marker in _FRAMES:
            _check_size(*_frame_size(data, at), where)
    raise TruncatedPictureError(
        "the JPEG ends before its picture is complete",
        where=where,
        remedy="Copy the file from the camera again; a half-written image is not used",
    )


def end_of_jpeg(data: bytes, where: str) -> int:
    """Return the length in bytes of a JPEG's picture; cameras append previews, with metadata of their own, after it.

    Raises:
        DataError: the data are no whole JPEG (`check_jpeg`).
    """
    check_jpeg(data, where)
    return next(at + 2 for marker, at in _segments(data, where) if marker == _END_OF_IMAGE)


def without_metadata(data: bytes, where: str) -> bytes:
    """Return a JPEG, broken or not, without EXIF, XMP, IPTC and comments, and with its colour profile and all pixels.

    Raises:
        DataError: the data are no whole JPEG (`check_jpeg`).
    """
    end = end_of_jpeg(data, where)
    kept, begin = bytearray(), 0
    for at in (at for marker, at in _segments(data, where) if marker in _METADATA):
        kept += data[begin:at]
        begin = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return bytes(kept + data[begin:end])


def check_png(data: bytes, where: str) -> None:
    """Check that a PNG is complete, by walking its chunks and their checksums to the end.

    Raises:
        TruncatedPictureError: the file ends before its picture does.
        DataError: the file is damaged, or claims more pixels than any camera has.
    """
    _check_size(int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big"), where)
    at, kind = len(PNG_BEGINS), b""
    while kind != b"IEND":
        length, kind = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        end = at + 8 + length
        if end + 4 > len(data):  # a decoder would allocate the claimed length, up to four gigabytes
            raise TruncatedPictureError(
                "the PNG ends before its picture is complete",
                where=where,
                remedy="Copy the file again; a half-written image is not used",
            )
        if zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            raise DataError("the PNG is damaged", where=where, remedy="Copy the file again")
        at = end + 4


def check_webp(data: bytes, where: str) -> None:
    """Check that a WebP file is as long as it says. Raises TruncatedPictureError if it is not."""
    if len(data) < 8 + int.from_bytes(data[4:8], "little"):
        raise TruncatedPictureError(
            "the WebP ends before its picture is complete",
            where=where,
            remedy="Copy the file again; a half-written image is not used",
        )


def check_picture(data: bytes, where: str, *, partly: bool = False) -> None:
    """Check a JPEG, PNG or WebP without decoding it, and no other format. `partly` accepts a truncated JPEG.

    Raises:
        DataError: the picture is damaged (`check_jpeg`, `check_png`).
    """
    if data.startswith(PNG_BEGINS):
        check_png(data, where)
    elif data.startswith(JPEG_BEGINS) and not partly:
        check_jpeg(data, where)
    elif kind_of(data) == "WebP":
        check_webp(data, where)


def picture_size(data: bytes, where: str = "its first bytes") -> tuple[int, int]:
    """Return width and height of a JPEG or PNG in pixels as stored, from its header; the rest may be missing.

    Raises:
        DataError: it is neither, or its header is damaged or missing.
    """
    if data.startswith(PNG_BEGINS) and len(data) >= 24:
        return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    if data.startswith(JPEG_BEGINS):
        for marker, at in _segments(data, where):
            if marker in _FRAMES and at + 9 <= len(data):
                return _frame_size(data, at)
    raise DataError("the file is not a picture", where=where, remedy="Only JPEG and PNG are shown")


def _segments(data: bytes, where: str) -> Iterator[tuple[int, int]]:
    """Marker and position of each segment up to the end of image, or to where the data end. Raises DataError."""
    at = len(JPEG_BEGINS)
    while at + 2 <= len(data):
        if data[at] != 0xFF:
            raise DataError("the JPEG's structure is damaged", where=where, remedy="Copy the file again")
        marker = data[at + 1]
        if marker == _FILL:
            at += 1
            continue
        if marker in _STANDALONE:
            at += 2
            continue
        if marker == _END_OF_IMAGE:
            yield marker, at
            return
        if at + 4 > len(data):
            return
        yield marker, at
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if marker == _START_OF_SCAN:
            end = _END_OF_SCAN.search(data, at)
            if end is None:
                return
            at = end.start()


def _frame_size(data: bytes, at: int) -> tuple[int, int]:
    """Return width and height of a frame header that begins at `at`."""
    return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")


def _check_size(width: int, height: int, where: str) -> None:
    if width * height > MOST_PIXELS:
        raise DataError(
            f"the image claims to have {width} × {height} pixels",
            where=where,
            remedy="Copy the file from the camera again; no camera takes such images",
        )
