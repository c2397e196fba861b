"""Reads a folder of images by one rule for all commands: odd files are left out, damaged ones are errors.

Odd files are intact but do not belong: macOS's notes beside files (`._…`), second copies of an image, images of
another size, files of a kind that is not read under the name of one that is. `strict` refuses these too.
"""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from service.compute.images.files import image_size
from service.core.errors import DataError
from service.core.jpeg_damage import damaged_jpegs
from service.core.picture_files import ForeignKindError
from service.core.text.counts import counted

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".pnm", ".webp"})
READ = "JPEG, PNG, TIFF, BMP, PGM, PNM and WebP files are read"
_OTHER_SUFFIXES = frozenset({".heic", ".heif", ".avif", ".jxl"})
_NAMED = 5  # damaged files named in an error


@dataclass(frozen=True, slots=True)
class ImageFolder:
    """Images of a folder, by name, and the reasons for files left out."""

    files: tuple[Path, ...]
    left_out: dict[str, str] = field(default_factory=dict[str, str])

    def without(self, reasons: dict[str, str]) -> ImageFolder:
        """The folder without these images, whose reasons are added."""
        kept = tuple(file for file in self.files if file.name not in reasons)
        return ImageFolder(kept, self.left_out | reasons)


def image_folder(folder: Path, *, size: tuple[int, int] | None = None, strict: bool = False) -> ImageFolder:
    """The images of a folder, each checked to be complete, unique and of the wanted size.

    Args:
        folder: subfolders are not searched.
        size: width and height that the images must have; None: the most common size.
        strict: whether odd files are errors too.

    Raises:
        DataError: the folder does not exist, has no image (of the size), or has damaged ones (all are counted); with
            `strict`, it has odd ones.
    """
    if not folder.is_dir():
        raise DataError("the image folder does not exist", where=str(folder), remedy="Check --images")
    present = sorted(file for file in folder.iterdir() if file.is_file() and file.suffix.lower() in IMAGE_SUFFIXES)
    reasons = {file.name: "a hidden file, not an image" for file in present if file.name.startswith(".")}
    shown = [file for file in present if file.name not in reasons]
    if not shown:
        others = [file for file in sorted(folder.iterdir()) if file.suffix.lower() in _OTHER_SUFFIXES]
        held = f": {others[0].name} is not of a kind that is read" if others else ""
        raise DataError(f"no image in this folder{held}", where=str(folder), remedy=READ)
    sizes, foreign = _sizes(shown, folder)
    reasons |= foreign | _copies(shown)
    shown = [file for file in shown if file.name in sizes]
    if not shown:
        name, reason = next(iter(foreign.items()))
        raise DataError(f"no image in this folder can be read; {name}: {reason}", where=str(folder), remedy=READ)
    wanted = size or Counter(sizes[file.name] for file in shown if file.name not in reasons).most_common(1)[0][0]
    for file in shown:
        if file.name not in reasons and sizes[file.name] != wanted:
            reasons[file.name] = (
                f"{_words(sizes[file.name])}, {'the camera' if size else 'most images'} {_words(wanted)}"
            )
    if all(file.name in reasons for file in shown):
        most = Counter(sizes.values()).most_common(1)[0][0]
        raise DataError(
            f"the images are {_words(most)}, the camera model is for {_words(wanted)}",
            where=str(folder),
            remedy="Use the calibration made at this image size, and images that no program has rotated or resized",
        )
    if reasons and strict:
        raise strict_refusal(reasons, folder)
    return ImageFolder(tuple(file for file in shown if file.name not in reasons), reasons)


def strict_refusal(reasons: dict[str, str], folder: Path) -> DataError:
    """The error for odd files with `--strict`."""
    return DataError(
        f"{counted(len(reasons), 'odd file')}: " + "; ".join(f"{name}: {reason}" for name, reason in reasons.items()),
        where=str(folder),
        remedy="Remove them from the folder, or omit --strict to skip them",
    )


def _sizes(files: Sequence[Path], folder: Path) -> tuple[dict[str, tuple[int, int]], dict[str, str]]:
    """The sizes of the images, and the reasons why others, though whole, are not read."""
    sizes: dict[str, tuple[int, int]] = {}
    foreign: dict[str, str] = {}
    damaged: list[str] = []
    for file in files:
        try:
            sizes[file.name] = image_size(file)
        except ForeignKindError as error:
            foreign[file.name] = f"{error.what}. {error.remedy}"
        except DataError as error:
            damaged.append(f"{file.name}: {error.what}")
    within = damaged_jpegs([file for file in files if file.name in sizes])
    damaged += [f"{file.name}: {what}" for file, what in within.items()]
    if damaged:
        rest = f"; and {len(damaged) - _NAMED} more" if len(damaged) > _NAMED else ""
        raise DataError(
            f"{len(damaged)} of {len(files)} images are damaged: {'; '.join(damaged[:_NAMED])}{rest}",
            where=str(folder),
            remedy="Copy them from the camera again, or take them out of the folder",
        )
    return sizes, foreign


def _copies(files: Sequence[Path]) -> dict[str, str]:
    """Images that are byte-for-byte copies of an earlier one, with reasons."""
    alike: defaultdict[int, list[Path]] = defaultdict(list)
    for file in files:
        alike[file.stat().st_size].append(file)
    reasons: dict[str, str] = {}
    for group in alike.values():
        if len(group) < 2:
            continue
        first: dict[str, str] = {}
        for file in group:
            with file.open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256").hexdigest()
            if digest in first:
                reasons[file.name] = f"the same file as {first[digest]}"
            else:
                first[digest] = file.name
    return reasons


def _words(size: tuple[int, int]) -> str:
    return f"{size[0]} × {size[1]} px"
