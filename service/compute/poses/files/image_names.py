"""Matches the names of images in a table with the images of a folder, whatever program wrote it.

Programs write paths of their own computer, with backslashes and drive letters, leave the extension out, and change
the case or the Unicode form of letters. A name that fits only one image that way is that image's; one that fits
several is refused.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Collection, Sequence
from pathlib import PurePosixPath

from service.core.errors import DataError

_DRIVE = re.compile(r"[A-Za-z]:")
_PICTURES = frozenset({
    ".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".pnm", ".webp", ".exr",
    ".heic", ".heif", ".avif", ".jxl", ".jp2", ".arw", ".cr2", ".cr3", ".dng", ".nef", ".orf", ".pef", ".raf", ".rw2",
})  # fmt: skip
_NAMED = 3


def matched_names(images: Sequence[str], named: Collection[str], where: str, *, what: str = "pose") -> dict[str, str]:
    """For each image that a file names, its name there.

    Args:
        images: names of image files.
        named: the names in the file.
        where: names the file in errors.
        what: the file has of each image.

    Raises:
        DataError: a name in the file can be several images, or several names one image.
    """
    found = {image: image for image in images if image in named}
    place = (where, what)
    for key in (_file, _composed, _caseless):
        _match(images, named, key, key, found, place)
    bare = [name for name in named if PurePosixPath(_composed(name)).suffix.lower() not in _PICTURES]
    for key in (_composed, _caseless):
        _match(images, bare, lambda image, key=key: _stem(key(image)), key, found, place)
    return found


def _match(
    images: Sequence[str],
    named: Collection[str],
    of_image: Callable[[str], str],
    of_name: Callable[[str], str],
    found: dict[str, str],
    place: tuple[str, str],
) -> None:
    """Add the images whose key is that of one name; those that were found before do not count."""
    used = set(found.values())
    names: dict[str, list[str]] = {}
    for name in named:
        if name not in used:
            names.setdefault(of_name(name), []).append(name)
    alike: dict[str, list[str]] = {}
    for image in images:
        if image not in found and of_image(image) in names:
            alike.setdefault(of_image(image), []).append(image)
    for key, those in alike.items():
        if len(those) > 1 or len(names[key]) > 1:
            raise DataError(
                f"it is not clear whose {place[1]} it is: {some_names(names[key])} can be {some_names(those)}",
                where=place[0],
                remedy="Name the images in the file as they are named in their folder",
            )
        found[those[0]] = names[key][0]


def _file(name: str) -> str:
    """The file's name without its folders, whichever system wrote the path."""
    return PurePosixPath(_DRIVE.sub("", name.strip().replace("\\", "/"), count=1)).name


def _composed(name: str) -> str:
    """The file's name with composed letters: macOS stores ä as a and two dots."""
    return unicodedata.normalize("NFC", _file(name))


def _caseless(name: str) -> str:
    return _composed(name).casefold()


def _stem(name: str) -> str:
    return PurePosixPath(name).stem


def some_names(names: Sequence[str]) -> str:
    """The first names of several, for messages."""
    return ", ".join(names[:_NAMED]) + (", …" if len(names) > _NAMED else "")
