"""Resamples photographs with the matching camera, undistorted or to another resolution, and copies their EXIF."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.images.render import pixel_rays
from service.core.errors import ConfigurationError, DataError
from service.core.geometry import Array
from service.core.picture_files import JPEG_BEGINS, end_of_jpeg, picture_size, without_metadata

_RAYS = 500_000  # pixels whose places in the photograph are in memory at a time


@dataclass(frozen=True, slots=True)
class Undistorted:
    """A resampled photograph.

    Attributes:
        camera: its intrinsics, without distortion.
        image: (H, W, 3) BGR or (H, W) grey; black where the photograph has no pixel.
        valid: (H, W) where the photograph has a pixel.
    """

    camera: CameraModel
    image: NDArray[np.uint8]
    valid: NDArray[np.bool_]


def pinhole_of(camera: CameraModel) -> CameraModel:
    """Return the camera without its distortion: same size, focal lengths and principal point."""
    return dataclasses.replace(camera, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0, k4=0.0, k5=0.0, k6=0.0)


def undistorted(image: NDArray[np.uint8], camera: CameraModel) -> Undistorted:
    """Return the photograph (H, W) or (H, W, 3) as the pinhole camera `pinhole_of(camera)` would have taken it.

    Cubic interpolation at places rounded to 1/32 px, in tiles of rows.
    """
    pinhole = pinhole_of(camera)
    out = np.empty_like(image)
    valid = np.empty(image.shape[:2], dtype=np.bool_)
    for begin, end, at in _places(pinhole, camera):
        valid[begin:end] = _within(at, camera)
        places = at.astype(np.float32)
        part = cv2.remap(image, places[..., 0], places[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        part[~valid[begin:end]] = 0
        out[begin:end] = part
    return Undistorted(pinhole, out, valid)


def valid_pixels(camera: CameraModel) -> NDArray[np.bool_]:
    """Return (H, W) pixels of the undistorted image for which the photograph has one."""
    valid = np.empty((camera.height, camera.width), dtype=np.bool_)
    for begin, end, at in _places(pinhole_of(camera), camera):
        valid[begin:end] = _within(at, camera)
    return valid


def _places(pinhole: CameraModel, camera: CameraModel) -> Iterator[tuple[int, int, Array]]:
    """Yield tiles of rows [begin, end) of the undistorted image, and (end - begin, W, 2) places in the photograph."""
    rays = pixel_rays(pinhole)
    step = max(1, _RAYS // camera.width)
    for begin in range(0, camera.height, step):
        end = min(begin + step, camera.height)
        xy = rays.xy(begin, end)
        at = camera.project(np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=2).reshape(-1, 3))
        yield begin, end, at.reshape(end - begin, camera.width, 2)


def _within(at: Array, camera: CameraModel) -> NDArray[np.bool_]:
    inside = (at >= -0.5) & (at <= np.array([camera.width, camera.height]) - 0.5)
    return inside[..., 0] & inside[..., 1]


def camera_at(camera: CameraModel, width: int, height: int) -> CameraModel:
    """Return the camera of the image that `resample` returns.

    Raises:
        ConfigurationError: the size is larger than the photograph.
    """
    whole = _whole(camera, width, height)
    x, y = (whole.width - width) // 2, (whole.height - height) // 2
    return dataclasses.replace(whole, width=width, height=height, cx=whole.cx - x, cy=whole.cy - y)


def resample(image: NDArray[np.uint8], camera: CameraModel, width: int, height: int) -> NDArray[np.uint8]:
    """Resize a photograph (H, W, 3) to (height, width, 3): reduce by area averaging, then crop evenly.

    An aspect ratio other than the camera's (1920 × 1080 from a 3:2 sensor, as in the paper) crops two sides; pixels
    stay square.

    Raises:
        ConfigurationError: the size is larger than the photograph.
    """
    whole = _whole(camera, width, height)
    reduced = cv2.resize(image, (whole.width, whole.height), interpolation=cv2.INTER_AREA)
    x, y = (whole.width - width) // 2, (whole.height - height) // 2
    return np.ascontiguousarray(reduced[y : y + height, x : x + width], dtype=np.uint8)


def _whole(camera: CameraModel, width: int, height: int) -> CameraModel:
    scale = max(width / camera.width, height / camera.height)
    if scale > 1 or width < 1 or height < 1:
        raise ConfigurationError(
            f"{width} × {height} is not a reduction of {camera.width} × {camera.height}",
            remedy="Name resolutions that are smaller than the photographs, or none",
        )
    return camera.scaled(max(width, round(camera.width * scale)), max(height, round(camera.height * scale)))


# Preserves the EXIF of exported photographs and copies it to resampled ones; on request, without personal data.
#
# Personal data name a person or a place. The camera's serial numbers do too where one person owns the camera.


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
