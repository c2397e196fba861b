"""Preserves the EXIF of exported photographs and copies it to resampled ones; on request, without personal data.

Personal data name a person or a place. The camera's serial numbers do too where one person owns the camera.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from service.core.errors import DataError
from service.core.picture_files import JPEG_BEGINS, end_of_jpeg, picture_size, without_metadata

exiv2: Any = importlib.import_module("exiv2")  # the library has no types

_PERSONAL_WORDS = ("serial", "owner", "artist", "copyright", "author", "usercomment", "uniqueid", "hostcomputer")
#: Groups of tags that stay; GPS, makers' notes and previews go. Makers' notes hold serial numbers in many places.
_KEPT_GROUPS = ("Image", "Photo", "Iop")
_MAKER_NOTES = ("MakerNote", "MakerNoteSafety", "DNGPrivateData", "XMLPacket", "IPTCNAA", "ImageResources")
_SHORTEST_SOUGHT = 5  # a shorter value may stand anywhere by chance


def without_personal_data(picture: bytes, where: str = "") -> bytes:
    """Remove GPS, owner, author, serial numbers, makers' notes and previews from a JPEG or PNG, but change no pixel.

    XMP, IPTC and comments are removed as a whole, and whatever follows the picture in the file; EXIF too, if it is
    broken.

    Raises:
        DataError: the file is not a picture, or a removed value still stands in it elsewhere.
    """
    if picture.startswith(JPEG_BEGINS):
        picture = picture[: end_of_jpeg(picture, where)]
    removed: list[bytes] = []

    def clean(image: Any) -> None:
        removed.extend(_remove_personal(image.exifData()))
        image.clearXmpPacket()
        image.clearXmpData()
        image.clearIptcData()
        image.clearComment()

    cleaned = _changed(picture, clean, where)
    if any(value in cleaned for value in removed):
        raise DataError(
            "the photograph repeats a serial number or a name outside its metadata",
            where=where,
            remedy="Remove it with a program for metadata, or export this photograph without removing personal data",
        )
    return cleaned


def with_metadata_of(original: bytes, resampled: bytes, *, personal: bool, where: str = "") -> bytes:
    """Return the resampled picture with the EXIF of the photograph that it was made from, and its own size in it.

    Args:
        original: JPEG or PNG as the camera wrote it.
        resampled: JPEG or PNG without metadata, which it stays if those of the original are broken.
        personal: true to carry over GPS, owner and serial numbers too.
        where: the file, for messages.

    Raises:
        DataError: one of them is not a picture.
    """
    try:
        source = _open(original, where).exifData()
    except _BrokenMetadataError:
        source = exiv2.ExifData()
    if not personal:
        _remove_personal(source)
    _remove_previews(source)
    width, height = picture_size(resampled, where)
    for key in ("Exif.Photo.PixelXDimension", "Exif.Image.ImageWidth"):
        if key in source:
            source[key] = exiv2.UShortValue(width) if width < 1 << 16 else exiv2.ULongValue(width)
    for key in ("Exif.Photo.PixelYDimension", "Exif.Image.ImageLength"):
        if key in source:
            source[key] = exiv2.UShortValue(height) if height < 1 << 16 else exiv2.ULongValue(height)
    if "Exif.Image.Orientation" in source:
        source["Exif.Image.Orientation"] = exiv2.UShortValue(1)  # the pixels stand as the camera model has them
    return _changed(resampled, lambda image: image.setExifData(source), where)


def described(picture: bytes, words: str, where: str = "") -> bytes:
    """Write a description that every viewer shows into the EXIF of a JPEG or PNG, but change no pixel.

    Broken EXIF is replaced.

    Raises:
        DataError: it is not a picture.
    """

    def describe(image: Any) -> None:
        image.exifData()["Exif.Image.ImageDescription"] = exiv2.AsciiValue(words)

    return _changed(picture, describe, where)


class _BrokenMetadataError(DataError):
    """A picture is whole, as far as can be seen, but its metadata are not."""


def _changed(picture: bytes, change: Callable[[Any], object], where: str) -> bytes:
    """Return the picture with its metadata changed; broken metadata of a JPEG are dropped before."""
    try:
        return _written(picture, change, where)
    except _BrokenMetadataError:
        if not picture.startswith(JPEG_BEGINS):
            raise
        return _written(without_metadata(picture, where), change, where)


def _written(picture: bytes, change: Callable[[Any], object], where: str) -> bytes:
    image = _open(picture, where)
    change(image)
    try:
        image.writeMetadata()  # reads the file once more, with other demands
    except exiv2.Exiv2Error as error:
        raise _broken(error, where) from error
    return bytes(image.io().mmap())


def _open(picture: bytes, where: str) -> Any:
    try:
        image = exiv2.ImageFactory.open(picture)
        image.readMetadata()
    except exiv2.Exiv2Error as error:
        raise _broken(error, where) from error
    return image


def _broken(error: Exception, where: str) -> _BrokenMetadataError:
    return _BrokenMetadataError(
        f"the photograph's metadata cannot be read: {error}", where=where, remedy="Copy the file again"
    )


def _remove_previews(exif: Any) -> None:
    exiv2.ExifThumb(exif).erase()


def _remove_personal(exif: Any) -> list[bytes]:
    """Remove tags, and return the texts that they had."""
    _remove_previews(exif)
    removed: list[bytes] = []
    kept = exiv2.ExifData()
    for tag in exif:
        name, group = str(tag.tagName()), str(tag.groupName())
        personal = any(word in name.lower() for word in _PERSONAL_WORDS)
        if group in _KEPT_GROUPS and name not in (*_MAKER_NOTES, "GPSTag") and not personal:
            kept.add(tag)
        elif personal:
            text = str(tag.toString()).strip("\0 ")
            if len(text) >= _SHORTEST_SOUGHT:
                removed.append(text.encode("utf-8", "surrogateescape"))
    exif.clear()
    for tag in kept:
        exif.add(tag)
    return removed
