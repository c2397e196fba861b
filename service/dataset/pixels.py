"""Pixel data of the views: photographs from files, computed depth and masks; undistorted and cropped views."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Generic, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.images.photographs import read_image_of
from service.compute.images.render import Cylinder, RayMesh, WorldSphere, depth_map, marker_mask, seen
from service.compute.images.resample import (
    described,
    pinhole_of,
    undistorted,
    valid_pixels,
    with_metadata_of,
    without_personal_data,
)
from service.compute.images.views import FULL_HD, ImageCrop, Splits, marker_free_crops
from service.core.errors import DataError
from service.dataset.records import DataSet, Pixels, PosedView
from service.machine.executors import file_here

_T = TypeVar("_T")
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 97, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


class _Last(Generic[_T]):
    """Keeps what was made last: crops of an image follow each other, and each image is decoded once for them all."""

    def __init__(self, make: Callable[[PosedView], _T]) -> None:
        self._make = make
        self._kept: tuple[str, _T] | None = None

    def __getstate__(self) -> dict[str, object]:
        """Return what travels to another process: not what was made."""
        return {"_make": self._make, "_kept": None}

    def of(self, view: PosedView) -> _T:
        """Return what was made for a view; it must not be written to."""
        if self._kept is None or self._kept[0] != view.name:
            self._kept = None  # the memory of the last one is free while the next is made
            self._kept = (view.name, self._make(view))
        return self._kept[1]


class Photographs:
    """Views as they were photographed, in front of a mesh with markers."""

    def __init__(
        self,
        files: Mapping[str, Path],
        surface: RayMesh,
        spheres: Sequence[WorldSphere],
        posts: Sequence[Cylinder] = (),
        *,
        personal: bool = True,
        mark: str = "",
    ) -> None:
        """Take the files by the names of their views.

        Args:
            files: JPEG or PNG, by name of the view.
            surface: the mesh in the world frame.
            spheres: spheres in the world frame.
            posts: that carry them.
            personal: False removes GPS, owner and serial numbers from the pictures.
            mark: written into the pictures' description where it is not empty.
        """
        self._files, self._surface, self._spheres, self._posts = files, surface, spheres, posts
        self._personal, self._mark = personal, mark
        self._colours = _Last(self._read)

    def files(self, view: PosedView) -> tuple[Path, ...]:
        """Return the photograph."""
        return (self._files[view.name],)

    def picture(self, view: PosedView) -> bytes:
        """Return the file as the camera wrote it, except what was to be removed or marked."""
        try:
            data = file_here(self._files[view.name]).read_bytes()
        except OSError as error:
            raise DataError(
                f"the photograph cannot be read: {error.strerror}", where=view.name, remedy="Verify the evidence"
            ) from error
        if not self._personal:
            data = without_personal_data(data, view.name)
        return described(data, self._mark, view.name) if self._mark else data

    def colours(self, view: PosedView) -> NDArray[np.uint8]:
        """Return the colours (H, W, 3), BGR."""
        return self._colours.of(view)

    def _read(self, view: PosedView) -> NDArray[np.uint8]:
        return read_image_of(file_here(self._files[view.name]), view.camera)

    def depth_m(self, view: PosedView) -> NDArray[np.float32]:
        """Return the depth (H, W), z of the mesh."""
        return depth_map(self._surface, view.camera, view.T_world_camera)

    def normal(self, view: PosedView) -> NDArray[np.float32]:
        """Return the normals (H, W, 3) of the mesh."""
        return seen(self._surface, view.camera, view.T_world_camera).normal

    def valid(self, view: PosedView) -> NDArray[np.bool_]:
        """Return which pixels (H, W) the photograph has: all of them."""
        return np.ones((view.camera.height, view.camera.width), dtype=np.bool_)

    def markers(self, view: PosedView) -> NDArray[np.bool_]:
        """Return which pixels (H, W) show a sphere or a post."""
        return marker_mask(view.camera, view.T_world_camera, self._spheres, self._posts)


class PixelsOfAnother:
    """The pixels of another data set as they are: a base of pixels that differ in some respects."""

    def __init__(self, inner: Pixels) -> None:
        """Take the other data set's pixels."""
        self._inner = inner

    def files(self, view: PosedView) -> tuple[Path, ...]:
        """Return the files of the other data set."""
        return self._inner.files(view)

    def picture(self, view: PosedView) -> bytes:
        """Return the picture's file."""
        return self._inner.picture(view)

    def colours(self, view: PosedView) -> NDArray[np.uint8]:
        """Return the colours (H, W, 3), BGR."""
        return self._inner.colours(view)

    def depth_m(self, view: PosedView) -> NDArray[np.float32]:
        """Return the depth (H, W), z of the mesh."""
        return self._inner.depth_m(view)

    def normal(self, view: PosedView) -> NDArray[np.float32]:
        """Return the normals (H, W, 3) of the mesh."""
        return self._inner.normal(view)

    def valid(self, view: PosedView) -> NDArray[np.bool_]:
        """Return which pixels the photograph has, (H, W)."""
        return self._inner.valid(view)

    def markers(self, view: PosedView) -> NDArray[np.bool_]:
        """Return which pixels (H, W) show a sphere or a post."""
        return self._inner.markers(view)


class UndistortedViews(PixelsOfAnother):
    """The views of a data set as pinhole cameras: `undistorted_data_set` makes them.

    Depth, normals and markers are computed for the camera of each view, and so for the pinhole.
    """

    def __init__(self, distorted: DataSet, *, personal: bool) -> None:
        """Resample the views of `distorted`; they keep their names."""
        super().__init__(distorted.pixels)
        self._sources, self._personal = {view.name: view for view in distorted.views}, personal
        self._colours = _Last(self._resampled)

    def files(self, view: PosedView) -> tuple[Path, ...]:
        """Return the photograph."""
        return self._inner.files(self._sources[view.name])

    def picture(self, view: PosedView) -> bytes:
        """Return the resampled picture, with the photograph's metadata."""
        return _encoded(view, self.colours(view), self._inner.picture(self._sources[view.name]), self._personal)

    def colours(self, view: PosedView) -> NDArray[np.uint8]:
        """Return the colours (H, W, 3), BGR; black where the photograph has no pixel."""
        return self._colours.of(view)

    def _resampled(self, view: PosedView) -> NDArray[np.uint8]:
        source = self._sources[view.name]
        return undistorted(self._inner.colours(source), source.camera).image

    def valid(self, view: PosedView) -> NDArray[np.bool_]:
        """Return which pixels the photograph has, (H, W)."""
        return valid_pixels(self._sources[view.name].camera)


class Cropped(PixelsOfAnother):
    """Parts of the views of a data set, without markers: `cropped_data_set` makes them."""

    def __init__(self, whole: DataSet, crops: Mapping[str, tuple[PosedView, ImageCrop]], *, personal: bool) -> None:
        """Take the whole data set, and for each new view its source and its place there."""
        super().__init__(whole.pixels)
        self._crops, self._personal = crops, personal
        self._originals = _Last(whole.pixels.picture)

    def files(self, view: PosedView) -> tuple[Path, ...]:
        """Return the files of the source."""
        return self._inner.files(self._crops[view.name][0])

    def picture(self, view: PosedView) -> bytes:
        """Return the picture, cut out and encoded again, with the metadata of the photograph."""
        original = self._originals.of(self._crops[view.name][0])
        return _encoded(view, self.colours(view), original, self._personal)

    def colours(self, view: PosedView) -> NDArray[np.uint8]:
        """Return the colours (H, W, 3), BGR."""
        source, crop = self._crops[view.name]
        return np.ascontiguousarray(self._inner.colours(source)[crop.slices])

    def valid(self, view: PosedView) -> NDArray[np.bool_]:
        """Return which pixels the source has, (H, W)."""
        source, crop = self._crops[view.name]
        return self._inner.valid(source)[crop.slices]


def undistorted_data_set(dataset: DataSet, *, personal: bool = True) -> DataSet:
    """Return the views with pinhole cameras (`pinhole_of`) and resampled pictures; unchanged without distortion."""
    if not any(view.camera.distortion.any() for view in dataset.views):
        return dataset
    views = tuple(dataclasses.replace(view, camera=pinhole_of(view.camera)) for view in dataset.views)
    pixels = UndistortedViews(dataset, personal=personal)
    return dataclasses.replace(dataset, identity=f"{dataset.identity} undistorted", views=views, pixels=pixels)


def cropped_data_set(
    dataset: DataSet,
    wanted: Callable[[PosedView], NDArray[np.bool_]],
    size: tuple[int, int] = FULL_HD,
    *,
    most: int = 1,
    personal: bool = True,
) -> DataSet:
    """Return marker-free crops, named `VIEW_crop0`, `VIEW_crop1`, …, with the splits of their views.

    Args:
        dataset: whole images, distorted or not.
        wanted: (H, W) pixels of a view that show the specimen.
        size: width and height of a crop.
        most: crops of each view at most; views without a place free of markers have none.
        personal: False leaves GPS, owner and serial numbers out of the pictures.

    Raises:
        ConfigurationError: a crop is larger than an image.
        DataError: no view has a crop.
    """
    crops: dict[str, tuple[PosedView, ImageCrop]] = {}
    views: list[PosedView] = []
    children: dict[str, list[str]] = {}
    for view in dataset.views:
        forbidden = dataset.pixels.markers(view) | ~dataset.pixels.valid(view)
        for k, crop in enumerate(marker_free_crops(wanted(view), forbidden, size, most)):
            name = f"{view.name}_crop{k}"
            crops[name] = (view, crop)
            children.setdefault(view.name, []).append(name)
            views.append(dataclasses.replace(view, name=name, camera=crop.camera(view.camera)))
    if not views:
        raise DataError(
            f"no image has a part of {size[0]} × {size[1]} px without a sphere or post",
            remedy="Choose a smaller crop",
        )
    of_crops = {
        key: tuple(child for name in names for child in children.get(name, ()))
        for key, names in dataset.splits.named().items()
    }
    number = {view.name: k for k, view in enumerate(dataset.views)}
    return dataclasses.replace(
        dataset,
        identity=f"{dataset.identity} crops {size[0]}x{size[1]} {most}",
        views=tuple(views),
        pixels=Cropped(dataset, crops, personal=personal),
        splits=Splits(**of_crops),
        pose_errors=dataset.errors_of([number[crops[view.name][0].name] for view in views]),
    )


def _encoded(view: PosedView, colours: NDArray[np.uint8], original: bytes, personal: bool) -> bytes:
    """Encode as PNG, or as JPEG of quality 97 without subsampled colours, with the original's metadata."""
    encoded, data = cv2.imencode(view.suffix, colours, _JPEG if view.suffix == ".jpg" else ())
    if not encoded:
        raise DataError("the picture cannot be encoded", where=view.name, remedy="Export originals instead")
    return with_metadata_of(original, data.tobytes(), personal=personal, where=view.name)
