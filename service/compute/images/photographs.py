"""Reads photographs, single or a folder of them, decodes them for people, and measures their basic quality."""

from __future__ import annotations

import dataclasses
import hashlib
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.core.errors import DataError
from service.core.jpeg_damage import damaged_jpegs
from service.core.picture_files import (
    JPEG_BEGINS,
    ForeignKindError,
    another_kind,
    check_jpeg,
    check_picture,
    kind_of,
    picture_size,
)
from service.core.words import counted

# Kinds of pictures that nothing here decodes, and files that are no pictures.
_UNREAD = frozenset({
    "HEIC", "JPEG XL", "Photoshop", "raw file", "PDF", "ZIP", "video", "text", "Git LFS pointer"
})  # fmt: skip
_REMEDY = "Copy the file from the camera again, and use JPEG or PNG images"


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height of an image as stored, after checking that it is complete; a JPEG is not decoded.

    Raises:
        DataError: the file is missing, truncated or not a decodable image.
    """
    data = _read_content(path)
    if data.startswith(JPEG_BEGINS):
        return picture_size(data, str(path))
    height, width = _decoded(data, path, cv2.IMREAD_GRAYSCALE).shape
    return width, height


def _read_content(path: Path) -> bytes:
    """Return the content of an image file, which decides its kind, not its name."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise _unreadable(path, error) from error
    kind = kind_of(data)
    if kind in _UNREAD:
        raise another_kind(kind, "JPEG or PNG", str(path))
    if not kind and path.suffix.lower() in {".jpg", ".jpeg"}:
        check_jpeg(data, str(path))  # OpenCV would read some formats without a mark of their own
    check_picture(data, str(path))
    return data


def _unreadable(path: Path, error: OSError) -> DataError:
    return DataError(
        f"the image cannot be read: {error.strerror}",
        where=str(path),
        remedy="Check the path and its permissions",
    )


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read (H, W, 3) BGR as stored: the orientation tag is ignored, to match the camera model.

    Raises:
        DataError: the file is missing, truncated or not a decodable image.
    """
    return _decode(path, cv2.IMREAD_COLOR)


def read_grey(path: Path) -> NDArray[np.uint8]:
    """Read the (H, W) brightness as stored (a JPEG's luma, at full resolution), in a third of `read_image`'s memory.

    Raises:
        DataError: the file is missing, truncated or not a decodable image.
    """
    return _decode(path, cv2.IMREAD_GRAYSCALE)


def _decode(path: Path, how: int) -> NDArray[np.uint8]:
    return _decoded(_read_content(path), path, how)


def _decoded(data: bytes, path: Path, how: int) -> NDArray[np.uint8]:
    return decode(data, how | cv2.IMREAD_IGNORE_ORIENTATION, name=str(path), remedy=_REMEDY)


def read_image_of(path: Path, camera: CameraModel) -> NDArray[np.uint8]:
    """Read an image of the camera's size with `read_image`.

    Raises:
        DataError: the file is missing, truncated or not a decodable image, or the image has another size.
    """
    image = read_image(path)
    if image.shape[:2] != (camera.height, camera.width):
        raise DataError(
            f"the image has {image.shape[1]}×{image.shape[0]} pixels, "
            f"the camera model is for {camera.width}×{camera.height}",
            where=str(path),
            remedy="Use the calibration made at this image size, and images that no program has rotated or resized",
        )
    return image


def read_reduced(path: Path, camera: CameraModel, least_width: int) -> tuple[NDArray[np.uint8], CameraModel]:
    """Read the image reduced to a half, a quarter or an eighth, at least `least_width` wide, and its camera.

    A JPEG is decoded at that size, which takes a third of the time and at an eighth 1/64 of the memory.

    Raises:
        DataError: the file is missing, truncated or not a decodable image, or the image has another size.
    """
    reduction = next((k for k in (8, 4, 2) if camera.width // k >= least_width), 1)
    if reduction == 1:
        return read_image_of(path, camera), camera
    image = _decode(path, REDUCED[reduction])
    height, width = image.shape[:2]
    if abs(width - camera.width / reduction) >= 1 or abs(height - camera.height / reduction) >= 1:
        read_image_of(path, camera)  # raises with the size of the image as stored
    # Scale by the exact reduction factor, even if the last row or column covers fewer pixels.
    smaller = dataclasses.replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx / reduction,
        fy=camera.fy / reduction,
        cx=(camera.cx + 0.5) / reduction - 0.5,
        cy=(camera.cy + 0.5) / reduction - 0.5,
    )
    return image, smaller


# Reads a folder of images by one rule for all commands: odd files are left out, damaged ones are errors.
#
# Odd files are intact but do not belong: macOS's notes beside files (`._…`), second copies of an image, images of
# another size, files of a kind that is not read under the name of one that is. `strict` refuses these too.


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
        """Return the folder without these images, whose reasons are added."""
        kept = tuple(file for file in self.files if file.name not in reasons)
        return ImageFolder(kept, self.left_out | reasons)


def image_folder(folder: Path, *, size: tuple[int, int] | None = None, strict: bool = False) -> ImageFolder:
    """List the images of a folder, each checked to be complete, unique and of the wanted size.

    Args:
        folder: subfolders are not searched.
        size: width and height that the images must have; None: the most common size.
        strict: true if odd files are errors too.

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
    """Return the error for odd files with `--strict`."""
    return DataError(
        f"{counted(len(reasons), 'odd file')}: " + "; ".join(f"{name}: {reason}" for name, reason in reasons.items()),
        where=str(folder),
        remedy="Remove them from the folder, or omit --strict to skip them",
    )


def _sizes(files: Sequence[Path], folder: Path) -> tuple[dict[str, tuple[int, int]], dict[str, str]]:
    """Return the sizes of the images, and the reasons why others, though whole, are not read."""
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
    """Return the images that are byte-for-byte copies of an earlier one, with reasons."""
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


#: OpenCV's flag by the reduction of width and height: the decoder then does a part of the work only.
REDUCED = {8: cv2.IMREAD_REDUCED_COLOR_8, 4: cv2.IMREAD_REDUCED_COLOR_4, 2: cv2.IMREAD_REDUCED_COLOR_2}


def decode(content: bytes, how: int, *, name: str, remedy: str) -> NDArray[np.uint8]:
    """Decode a picture file as (H, W, 3) BGR or (H, W).

    Args:
        content: the file's content, which has been checked (service.core.picture_files).
        how: flags of cv2.imdecode.
        name: the file's name, for the error.
        remedy: advice to the reader of the error.

    Raises:
        DataError: OpenCV cannot decode it.
    """
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), how)
    except cv2.error as error:
        raise DataError(f"the image cannot be decoded: {error.err}", where=name, remedy=remedy) from error
    if image is None:
        raise DataError("the image cannot be decoded", where=name, remedy=remedy)
    return np.asarray(image, dtype=np.uint8)


_MOST_PIXELS = 250_000_000
_SHOWN_REMEDY = "Download the recorded file and look at it; it is kept unchanged as evidence"


def decode_reduced(
    content: bytes, width_px: int, name: str, *, upright: bool = False
) -> tuple[NDArray[np.uint8], int]:
    """Decode a JPEG or PNG as (H, W, 3) BGR, at most `width_px` wide; return its width as stored too.

    It is decoded at an eighth, a quarter or half of its size if that is wide enough, because 60 MP take long.

    Args:
        content: the file's content.
        width_px: narrower pictures keep their width.
        name: the file's name, for messages.
        upright: rotate by the orientation tag; otherwise the pixels are as stored, like those that are measured.

    Raises:
        DataError: it is not a picture that can be decoded, or has too many pixels to show.
    """
    stored_px, rows = picture_size(content, name)
    if stored_px * rows > _MOST_PIXELS:
        raise DataError(
            f"the picture has {stored_px} × {rows} pixels, which is too many to show",
            where=name,
            remedy=_SHOWN_REMEDY,
        )
    check_picture(content, name, partly=True)
    how = next((flag for k, flag in REDUCED.items() if stored_px // k >= width_px), cv2.IMREAD_COLOR)
    image = decode(content, how if upright else how | cv2.IMREAD_IGNORE_ORIENTATION, name=name, remedy=_SHOWN_REMEDY)
    height, width = image.shape[:2]
    if width > width_px:
        image = cv2.resize(image, (width_px, max(1, round(height * width_px / width))), interpolation=cv2.INTER_AREA)
    return np.asarray(image, dtype=np.uint8), stored_px


_TILES, _TILE_PX = (4, 3), 512  # one tile in each part of the image is examined, at full resolution
_REACH_PX = 8  # range on either side within which an edge's height is measured
_STEP = 30.0  # smallest edge height, grey levels, well above the noise
_SLOPE = 1.0  # grey levels per pixel
_STEEPEST = 97  # percentile of the edges' slopes: gradual shading has edges too, which say nothing about sharpness
_FEWEST = 50  # edges
_DARK = 12.0  # grey level that hardly any pixel of a black image exceeds
_SIGMA_PX = 0.7  # smoothing against noise


@dataclass(frozen=True, slots=True)
class ImageQuality:
    """Sharpness and brightness of an image.

    Attributes:
        edge_px: median width of its clearest edges (height over steepest slope); 2 to 4 in a sharp image, NaN if it
            has none.
        black: true if hardly any pixel is brighter than black.
    """

    edge_px: float
    black: bool


def image_quality(grey: NDArray[np.uint8]) -> ImageQuality:
    """Return the quality of an image (H, W); takes some milliseconds per megapixel examined, at most three."""
    dark = float(np.percentile(grey[::4, ::4], 99)) < _DARK
    return ImageQuality(float("nan") if dark else _edge_px(grey), dark)


def _edge_px(grey: NDArray[np.uint8]) -> float:
    height, width = grey.shape
    columns, rows = _TILES
    steps: list[NDArray[np.float32]] = []
    slopes: list[NDArray[np.float32]] = []
    for part in np.array_split(np.arange(height), rows):
        for across in np.array_split(np.arange(width), columns):
            tile = grey[_middle(part), _middle(across)]
            step, slope = _edges(tile)
            steps.append(step)
            slopes.append(slope)
    step, slope = np.concatenate(steps), np.concatenate(slopes)
    if len(step) < _FEWEST:
        return float("nan")
    clear = slope >= np.percentile(slope, _STEEPEST)
    return float(np.median(step[clear] / slope[clear]))


def _middle(part: NDArray[np.int64]) -> slice:
    spare = max(0, len(part) - _TILE_PX) // 2
    return slice(int(part[0]) + spare, int(part[-1]) + 1 - spare)


def _edges(tile: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the height and steepest slope of every edge in a tile."""
    smooth = np.asarray(cv2.GaussianBlur(tile, (0, 0), _SIGMA_PX), dtype=np.float32)
    across = (smooth[1:-1, 2:] - smooth[1:-1, :-2]) / 2
    along = (smooth[2:, 1:-1] - smooth[:-2, 1:-1]) / 2
    slope = np.hypot(across, along)
    around = np.ones((2 * _REACH_PX + 1, 2 * _REACH_PX + 1), dtype=np.uint8)
    step = np.asarray(cv2.dilate(smooth, around) - cv2.erode(smooth, around), dtype=np.float32)[1:-1, 1:-1]
    ridge = slope >= cv2.dilate(slope, np.ones((3, 3), dtype=np.uint8))
    clear = ridge & (step > _STEP) & (slope > _SLOPE)
    return step[clear], slope[clear]
