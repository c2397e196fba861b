"""Records of a posed data set: one frame, metres, and pixel data that are read only when they are asked for."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from typing import Protocol as Interface

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.pixels.views import Splits
from service.core.errors import DataError
from service.core.geometry import Array, Transform
from service.dataset.posed.about import About

SIMULATED = "SIMULATED: made by a simulated rig, not by a camera in front of a specimen"


@dataclass(frozen=True, slots=True)
class PosedView:
    """One image.

    Attributes:
        name: without suffix; unique, of letters, digits, `_`, `-` and `.`.
        suffix: of its picture file, `.jpg` or `.png`.
        camera: at the size of the picture; pixel centres at integer coordinates.
        T_world_camera: (4, 4) m; x right, y down, z forward.
        covariance: (6, 6) of (d, w): exp([w]x) R, t + d in the axes of the world, m and rad.
        taken: time that the photograph states, as EXIF has it; "" if it states none.
        device: name in rig.yaml of the further camera that took it; "": the first camera.
    """

    name: str
    suffix: str
    camera: CameraModel
    T_world_camera: Transform
    covariance: Array
    taken: str = ""
    device: str = ""

    @property
    def file(self) -> str:
        """Name of the picture file."""
        return self.name + self.suffix


@dataclass(frozen=True, slots=True)
class Mesh:
    """The ground truth.

    Attributes:
        vertices_m: (V, 3) in the world frame.
        faces: (F, 3).
        source: (V,) where each vertex comes from, 0: CT, 1: scan, 2: blend; None: all from the scan.
        sigma_m: (V,) stated standard deviation along the normal; None: not stated.
    """

    vertices_m: Array
    faces: NDArray[np.int64]
    source: NDArray[np.uint8] | None = None
    sigma_m: Array | None = None


@dataclass(frozen=True, slots=True)
class ScanFile:
    """A file of the scanner's own export: in the frame of the scan and in the unit that the scanner wrote."""

    name: str  # relative, with `/`
    path: Path


class Pixels(Interface):
    """What belongs to the pixels of a view; read or computed at each call, at the size of `view.camera`."""

    def picture(self, view: PosedView) -> bytes:
        """The JPEG or PNG file. Raises DataError if it cannot be read."""
        ...

    def colours(self, view: PosedView) -> NDArray[np.uint8]:
        """(H, W, 3) BGR of the picture. Raises DataError if it cannot be read."""
        ...

    def depth_m(self, view: PosedView) -> NDArray[np.float32]:
        """(H, W) z of the mesh in the camera frame, m; 0 where none is seen."""
        ...

    def normal(self, view: PosedView) -> NDArray[np.float32]:
        """(H, W, 3) unit normals of the mesh in the camera frame, towards the camera; 0 where none is seen."""
        ...

    def valid(self, view: PosedView) -> NDArray[np.bool_]:
        """(H, W) pixels that the picture has; others are outside the photograph that was resampled."""
        ...

    def markers(self, view: PosedView) -> NDArray[np.bool_]:
        """(H, W) pixels that a sphere or post covers."""
        ...


@dataclass(frozen=True, slots=True)
class DataSet:
    """Posed images with a mesh in one frame.

    Attributes:
        identity: differs where anything exported differs; an interrupted export goes on only with the same.
        simulated: nothing of it was measured.
        statement: JSON data on origin, devices, gates and deviations, for `dataset.json`.
        views: in order of their names.
        pixels: of the views.
        mesh: ground truth in the world frame.
        splits: of the names of the views.
        pose_errors: (6 V, 6 V) joint covariance of the poses in the views' order, as a view's covariance. Errors that
            are common to all views may be missing: they cancel in relative poses. None where it is not stated.
        about: the data set as a whole, for its data card and metadata.
        scan_files: the scanner's own export, with its textures.
    """

    identity: str
    simulated: bool
    statement: Mapping[str, Any]
    views: tuple[PosedView, ...]
    pixels: Pixels
    mesh: Mesh
    splits: Splits
    pose_errors: Array | None = None
    about: About = field(default_factory=About)
    scan_files: tuple[ScanFile, ...] = ()

    @property
    def mark(self) -> str:
        """The sentence that marks simulated data in every file with room for it; "" for a real capture."""
        return SIMULATED if self.simulated else ""

    def errors_of(self, views: Sequence[int]) -> Array | None:
        """(6 N, 6 N) `pose_errors` of the views with these numbers, which may repeat."""
        if self.pose_errors is None:
            return None
        rows = (6 * np.array(views, dtype=np.int64)[:, None] + np.arange(6)).ravel()
        return self.pose_errors[np.ix_(rows, rows)]

    def keeping(self, names: tuple[str, ...]) -> DataSet:
        """This data set with only these views, also in its splits."""
        chosen = set(names)
        cut = {key: tuple(n for n in split if n in chosen) for key, split in self.splits.named().items()}
        kept = [k for k, view in enumerate(self.views) if view.name in chosen]
        views = tuple(self.views[k] for k in kept)
        return dataclasses.replace(self, views=views, splits=Splits(**cut), pose_errors=self.errors_of(kept))

    @property
    def of_first_camera(self) -> DataSet:
        """This data set without the images of further cameras."""
        if not any(view.device for view in self.views):
            return self
        kept = self.keeping(tuple(view.name for view in self.views if not view.device))
        hashes = self.statement.get("image_sha256", {})
        named = {view.file: hashes[view.file] for view in kept.views if view.file in hashes}
        return dataclasses.replace(kept, statement={**self.statement, "image_sha256": named})


def only_camera(dataset: DataSet, of: str) -> CameraModel:
    """The camera of all views, for a format that has one.

    Raises:
        DataError: there is no view, or the views have several cameras.
    """
    cameras = {view.camera for view in dataset.views}
    if len(cameras) != 1:
        raise DataError(
            f"the data set has {len(cameras)} cameras, {of} has one",
            remedy="Choose COLMAP or nerfstudio, which have a camera for each image",
        )
    return cameras.pop()
