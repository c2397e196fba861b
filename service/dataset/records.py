"""Records of a posed data set: one frame, metres, pixel data read when asked for, and what is known of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from typing import Protocol as Interface

import numpy as np
from numpy.typing import NDArray

from service.computations.evaluate import ErrorBudget, Row
from service.compute.camera_model import CameraModel
from service.compute.images.views import Splits
from service.core.errors import DataError
from service.core.geometry import Array, Transform
from service.core.records.data_set import FIRST_VERSION, DataSetStatement, Party, doi_address, licence_address, party
from service.core.words import SIMULATED

NOT_STATED = "not stated"


@dataclass(frozen=True, slots=True)
class UsedDevice:
    """A device as it identified itself when it was opened; "" for what it did not report or what is left out."""

    name: str  # the name in rig.yaml
    model: str
    serial: str
    firmware: str


@dataclass(frozen=True, slots=True)
class About:
    """A data set as a whole; everything but `stated` and `version` is from the record.

    Attributes:
        stated: title, licence, ethics, creators and citation, from the protocol or the export's options.
        version: the data set's version.
        run: the run's identifier.
        protocol: the protocol's id, version and SHA-256.
        protocol_title: the protocol's title.
        source: the origin of the procedure.
        specimen: the specimen, as entered at the start of the run.
        purpose: the purpose, likewise.
        site: the site, likewise.
        origin: a sentence on how the photographs came into the run.
        published_utc: time of the last event that the data set rests on.
        head_sha256: hash of that event.
        software: version of this program.
        people: accounts of those who took part; empty if personal data are left out.
        devices: the devices that were opened.
        settings: settings of the camera and of the spheres, (name, value) as text.
        accuracy: the run's own registration in the evaluation's table; None if there is none.
        budget: the budget of its error.
        covariance: a sentence on what the covariances of the poses hold.
        mesh: a sentence on what the ground-truth mesh is.
        masks: a text on what the masks hold.
        fusion: (name, value) texts on how CT and scan agree and were fused; empty if the mesh is the scan.
        gates: verdicts as text, by step.
        accepted: gates accepted outside their limits, as text.
        deviations: deviations from the protocol, as text.
        later: results that arrived after the evaluation, as text.
        not_in_yet: results that had not arrived.
    """

    stated: DataSetStatement = field(default_factory=DataSetStatement)
    version: str = FIRST_VERSION
    run: str = ""
    protocol: str = ""
    protocol_title: str = ""
    source: str = ""
    specimen: str = ""
    purpose: str = ""
    site: str = ""
    origin: str = ""
    published_utc: str = ""
    head_sha256: str = ""
    software: str = ""
    people: tuple[str, ...] = ()
    devices: tuple[UsedDevice, ...] = ()
    settings: tuple[tuple[str, str], ...] = ()
    accuracy: Row | None = None
    budget: ErrorBudget | None = None
    covariance: str = ""
    mesh: str = ""
    masks: str = ""
    fusion: tuple[tuple[str, str], ...] = ()
    gates: tuple[tuple[str, tuple[str, ...]], ...] = ()
    accepted: tuple[str, ...] = ()
    deviations: tuple[str, ...] = ()
    later: tuple[str, ...] = ()
    not_in_yet: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """The title that was given; else the protocol's, and the specimen."""
        known = [self.protocol_title or "Posed images and a surface mesh", self.specimen]
        return self.stated.title or ": ".join(filter(None, known))

    @property
    def licence(self) -> str:
        """The text of the licence."""
        return self.stated.licence or "No licence was stated: ask the site that made the data set"

    @property
    def licence_address(self) -> str:
        """The address of the licence; "" where none was given, or a text as old protocols have it."""
        try:
            return licence_address(self.stated.licence)
        except DataError:
            return ""

    @property
    def ethics(self) -> str:
        """The text of the ethics statement."""
        return self.stated.ethics or "No ethics statement was given, neither in the protocol nor at the export"

    @property
    def creators(self) -> tuple[Party, ...]:
        """The makers of the data set: those given, else the site."""
        site = (Party(self.site, "Organization"),) if self.site else ()
        return tuple(_party(name) for name in self.stated.creators) or site

    @property
    def publisher(self) -> Party | None:
        """The publisher of the data set, if one was given."""
        return _party(self.stated.publisher, "Organization") if self.stated.publisher else None

    @property
    def funders(self) -> tuple[Party, ...]:
        """The funders of the data set."""
        return tuple(_party(name, "Organization") for name in self.stated.funders)

    @property
    def doi(self) -> str:
        """The address of the data set's DOI, if it was given and is one."""
        try:
            return doi_address(self.stated.doi)
        except DataError:
            return ""

    @property
    def citation(self) -> str:
        """The citation: the given one, else one put together from the record."""
        if self.stated.cite:
            return self.stated.cite
        names = ", ".join(maker.name for maker in self.creators)
        whose = f"{names}: " if names else ""
        where = f", {self.publisher.name}" if self.publisher is not None else ""
        which = f", {self.doi}" if self.doi else f", run {self.run}" if self.run else ""
        return f"{whose}{self.title}. Data set, version {self.version}{where}{which}."


def _party(text: str, otherwise: Literal["Person", "Organization", ""] = "") -> Party:
    """Return a given person or body; one that an older record has in a wrong format is named as it stands there."""
    try:
        return party(text, otherwise=otherwise)
    except DataError:
        return Party(text, otherwise or "Person")


@dataclass(frozen=True, slots=True)
class PosedView:
    """An image of the data set with its camera and pose.

    Attributes:
        name: the view's unique name without suffix, of letters, digits, `_`, `-` and `.`.
        suffix: suffix of its picture file, `.jpg` or `.png`.
        camera: the camera at the size of the picture; pixel centres are at integer coordinates.
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
        sigma_m: (V,) standard deviation along the normal; None: not known.
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
    """The pixel data of a view; read or computed at each call, at the size of `view.camera`."""

    def files(self, view: PosedView) -> tuple[Path, ...]:
        """Return the files from which the pixels of a view are made, so that these can travel."""
        ...

    def picture(self, view: PosedView) -> bytes:
        """Return the JPEG or PNG file. Raises DataError if it cannot be read."""
        ...

    def colours(self, view: PosedView) -> NDArray[np.uint8]:
        """Return the colours (H, W, 3) of the picture, BGR. Raises DataError if it cannot be read."""
        ...

    def depth_m(self, view: PosedView) -> NDArray[np.float32]:
        """Return the depth (H, W), z of the mesh in the camera frame, m; 0 where none is seen."""
        ...

    def normal(self, view: PosedView) -> NDArray[np.float32]:
        """Return unit normals (H, W, 3) of the mesh in the camera frame, towards the camera; 0 where none is seen."""
        ...

    def valid(self, view: PosedView) -> NDArray[np.bool_]:
        """Return which pixels (H, W) the picture has; others are outside the photograph that was resampled."""
        ...

    def markers(self, view: PosedView) -> NDArray[np.bool_]:
        """Return which pixels (H, W) a sphere or post covers."""
        ...


@dataclass(frozen=True, slots=True)
class DataSet:
    """Posed images with a mesh in one frame.

    Attributes:
        identity: differs where anything exported differs; an interrupted export goes on only with the same.
        simulated: nothing of it was measured.
        statement: JSON data on origin, devices, gates and deviations, for `dataset.json`.
        views: the views in order of their names.
        pixels: the views' pixels.
        mesh: ground truth in the world frame.
        splits: the splits of the views, by name.
        pose_errors: (6 V, 6 V) joint covariance of the poses in the views' order, as a view's covariance. Errors that
            are common to all views may be missing: they cancel in relative poses. None where it is not known.
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
        """Return (6 N, 6 N) `pose_errors` of the views with these numbers, which may repeat."""
        if self.pose_errors is None:
            return None
        rows = (6 * np.array(views, dtype=np.int64)[:, None] + np.arange(6)).ravel()
        return self.pose_errors[np.ix_(rows, rows)]

    def keeping(self, names: tuple[str, ...]) -> DataSet:
        """Return this data set with only these views, also in its splits."""
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
    """Return the camera of all views, for a format that has one.

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
