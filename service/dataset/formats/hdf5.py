"""HDF5 for training: arrays that need nothing but numpy and h5py, a loader beside them; and reading it back."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.resources
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from service.compute.camera_model import CameraModel
from service.compute.images.views import Splits
from service.core.errors import DataError
from service.core.text_files import parse_json
from service.dataset.export_folder import SUMS, ExportFolder, Part, check_folder
from service.dataset.exporter import Exporter, png
from service.dataset.pixels import PixelsOfAnother
from service.dataset.records import DataSet, Mesh, PosedView
from service.machine.executors import file_here

LOADER = "loader.py"


def write(dataset: DataSet, folder: ExportFolder) -> None:
    """`data.h5`, which links to `views/NAME.h5`, and `loader.py` for PyTorch users.

    A view has image (H, W, 3) RGB, depth_m (H, W) z in metres, normal (H, W, 3) in the camera frame, valid and
    markers (H, W), K (3, 3) for pixel centres at integers, distortion (8,) k1 k2 p1 p2 k3 k4 k5 k6, T_world_camera
    (4, 4) and covariance (6, 6); its attribute `camera` names the further camera that took it. Each view is a file of
    its own, so that an interrupted export goes on.
    The mesh has vertices_m and faces; if CT and scan were fused, source (0: CT, 1: scan, 2: blend) and sigma_m along
    the normal of each vertex.
    """
    for view in dataset.views:
        folder.written_by(
            f"views/{view.name}.h5", lambda path, view=view: _view(path, dataset, view), Part("arrays", view.name)
        )
    folder.written_by("data.h5", lambda part: _index(part, dataset))
    source = importlib.resources.files("service.dataset").joinpath("h5_loader.py")
    folder.file(LOADER, source.read_bytes)


def _view(path: Path, dataset: DataSet, view: PosedView) -> None:
    pixels, camera = dataset.pixels, view.camera
    rows = min(64, camera.height)
    with h5py.File(path, "w") as file:
        _about(file, dataset)
        images = {
            "image": pixels.colours(view)[..., ::-1],
            "depth_m": pixels.depth_m(view),
            "normal": pixels.normal(view),
            "valid": pixels.valid(view),
            "markers": pixels.markers(view),
        }
        for name, image in images.items():
            chunks = (rows, camera.width, *image.shape[2:])
            _write_array(file, name, image, chunks=chunks, compression="gzip", compression_opts=1)
        _write_array(file, "K", camera.matrix)
        terms = (camera.k1, camera.k2, camera.p1, camera.p2, camera.k3, camera.k4, camera.k5, camera.k6)
        _write_array(file, "distortion", np.array(terms))
        _write_array(file, "T_world_camera", view.T_world_camera)
        _write_array(file, "covariance", view.covariance)
        file.attrs["camera"] = view.device


def _index(path: Path, dataset: DataSet) -> None:
    with h5py.File(path, "w") as file:
        _about(file, dataset)
        for view in dataset.views:
            file[f"views/{view.name}"] = h5py.ExternalLink(f"views/{view.name}.h5", "/")
        for name, split in dataset.splits.named().items():
            _write_array(file, f"splits/{name}", np.array([view.encode() for view in split], dtype="S"))
        _write_array(file, "mesh/vertices_m", dataset.mesh.vertices_m)
        _write_array(file, "mesh/faces", dataset.mesh.faces)
        for name in ("source", "sigma_m"):
            if (values := getattr(dataset.mesh, name)) is not None:
                _write_array(file, f"mesh/{name}", values)


def _write_array(file: h5py.File, name: str, values: NDArray[Any], **layout: Any) -> None:
    """Write an array and close it at once.

    Where the parts of a file lie is decided when arrays are closed. Left to itself that is when nothing refers to
    them any more, and a thread that looks at frames for a moment, as the profiler of a Dask worker does, would decide
    on the bytes of the file.
    """
    file.create_dataset(name, data=values, **layout).id.close()


def _about(file: h5py.File, dataset: DataSet) -> None:
    file.attrs["simulated"] = dataset.simulated
    file.attrs["frame"] = "world, the frame of the mesh; T_world_camera: x right, y down, z forward"
    file.attrs["unit"] = "m"


KIND = Exporter("hdf5", "HDF5 for training, with a loader that needs only numpy and h5py", write)


INDEX = "data.h5"
_REMEDY = "Export it again with --format hdf5"
_SPLITS = TypeAdapter(Splits)


def data_set_of_folder(folder: Path) -> DataSet:
    """Return the data set that `orthocapture export --format hdf5` wrote; its identity is its `SHA256SUMS`' SHA-256.

    Raises:
        DataError: the folder is in another format, a file of it was changed or is missing, or it cannot be read.
    """
    if not (folder / INDEX).is_file() or not (folder / SUMS).is_file():
        raise DataError("this is not a data set in the format hdf5", where=str(folder), remedy=_REMEDY)
    check_folder(folder)
    try:
        return _read(folder)
    except ValidationError as error:
        raise DataError("splits.json does not name the views", where=str(folder), remedy=_REMEDY) from error
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise DataError(f"the data set cannot be read: {error}", where=str(folder), remedy=_REMEDY) from error


class StoredPixels:
    """The pixel data of views, as `hdf5` holds them."""

    def __init__(self, folder: Path, mark: str) -> None:
        """Take the folder of the data set; `mark` is written into pictures where it is not empty."""
        self._folder, self._mark = folder, mark

    def files(self, view: PosedView) -> tuple[Path, ...]:
        """Return the file of the view."""
        return (self._folder / "views" / f"{view.name}.h5",)

    def picture(self, view: PosedView) -> bytes:
        """Return the pixels as PNG: the camera's own file is not in the folder."""
        return png(self.colours(view), self._mark)

    def colours(self, view: PosedView) -> NDArray[np.uint8]:
        """Return the colours (H, W, 3), BGR."""
        return np.ascontiguousarray(self._array(view, "image")[..., ::-1], dtype=np.uint8)

    def depth_m(self, view: PosedView) -> NDArray[np.float32]:
        """Return the depth (H, W), z of the mesh."""
        return self._array(view, "depth_m").astype(np.float32)

    def normal(self, view: PosedView) -> NDArray[np.float32]:
        """Return the normals (H, W, 3) of the mesh."""
        return self._array(view, "normal").astype(np.float32)

    def valid(self, view: PosedView) -> NDArray[np.bool_]:
        """Return which pixels the photograph has, (H, W)."""
        return self._array(view, "valid").astype(np.bool_)

    def markers(self, view: PosedView) -> NDArray[np.bool_]:
        """Return which pixels show a sphere or a post, (H, W)."""
        return self._array(view, "markers").astype(np.bool_)

    def _array(self, view: PosedView, name: str) -> NDArray[Any]:
        try:
            (stored,) = self.files(view)
            with h5py.File(file_here(stored), "r") as file:
                return np.asarray(file[name])
        except (OSError, KeyError) as error:
            raise DataError(f"{name} cannot be read: {error}", where=view.name, remedy=_REMEDY) from error


def lossless_data_set(dataset: DataSet) -> DataSet:
    """Return the data set of a run as `data_set_of_folder` reads it from its export: with pictures without loss.

    So whoever computes from either computes the same.
    """
    views = tuple(dataclasses.replace(view, suffix=".png", taken="") for view in dataset.views)
    return dataclasses.replace(dataset, views=views, pixels=_Lossless(dataset))


class _Lossless(PixelsOfAnother):
    """The views of a data set with their pictures as PNG, in the place of the camera's own files."""

    def __init__(self, photographed: DataSet) -> None:
        super().__init__(photographed.pixels)
        self._mark = photographed.mark

    def picture(self, view: PosedView) -> bytes:
        return png(self.colours(view), self._mark)


def scaled_data_set(dataset: DataSet, width: int) -> DataSet:
    """Return the data set with pictures, depth and masks reduced to this width in pixels.

    Raises:
        DataError: a view is narrower.
    """
    narrow = min(view.camera.width for view in dataset.views)
    if narrow < width:
        raise DataError(f"an image is {narrow} px wide, less than {width} px", remedy="Ask for a smaller width")
    views = tuple(
        dataclasses.replace(view, camera=view.camera.scaled(width, _height(view.camera, width)))
        for view in dataset.views
    )
    return dataclasses.replace(
        dataset, identity=f"{dataset.identity} {width} px", views=views, pixels=_Scaled(dataset)
    )


class _Scaled:
    """Smaller pictures of the views of a data set."""

    def __init__(self, whole: DataSet) -> None:
        self._whole, self._views = whole, {view.name: view for view in whole.views}

    def files(self, view: PosedView) -> tuple[Path, ...]:
        return self._whole.pixels.files(self._views[view.name])

    def picture(self, view: PosedView) -> bytes:
        return png(self.colours(view), self._whole.mark)

    def colours(self, view: PosedView) -> NDArray[np.uint8]:
        image = self._whole.pixels.colours(self._views[view.name])
        size = (view.camera.width, view.camera.height)
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def depth_m(self, view: PosedView) -> NDArray[np.float32]:
        return self._nearest(self._whole.pixels.depth_m(self._views[view.name]), view).astype(np.float32)

    def normal(self, view: PosedView) -> NDArray[np.float32]:
        return self._nearest(self._whole.pixels.normal(self._views[view.name]), view).astype(np.float32)

    def valid(self, view: PosedView) -> NDArray[np.bool_]:
        return self._nearest(self._whole.pixels.valid(self._views[view.name]), view).astype(np.bool_)

    def markers(self, view: PosedView) -> NDArray[np.bool_]:
        return self._nearest(self._whole.pixels.markers(self._views[view.name]), view).astype(np.bool_)

    def _nearest(self, pixels: NDArray[Any], view: PosedView) -> NDArray[Any]:
        """Return the values (H, W, …) at the centres of the larger pixels."""
        rows, columns = (
            ((np.arange(small) + 0.5) * (large / small)).astype(np.int64)
            for small, large in zip((view.camera.height, view.camera.width), pixels.shape[:2], strict=True)
        )
        return pixels[np.ix_(rows, columns)]


def _height(camera: CameraModel, width: int) -> int:
    return round(camera.height * width / camera.width)


def _read(folder: Path) -> DataSet:
    of = _SPLITS.validate_json((folder / "splits.json").read_bytes())
    statement = parse_json((folder / "dataset.json").read_bytes(), name="dataset.json", remedy=_REMEDY)
    if not isinstance(statement, dict):
        raise TypeError("dataset.json is not a JSON object")
    with h5py.File(folder / INDEX, "r") as file:
        simulated = bool(file.attrs["simulated"])
        mesh = _mesh(file["mesh"])
    views = tuple(_read_view(folder, name) for name in sorted({*of.dense, *of.train, *of.test}))
    identity = hashlib.sha256((folder / SUMS).read_bytes()).hexdigest()
    dataset = DataSet(identity, simulated, statement, views, StoredPixels(folder, ""), mesh, of)
    return dataclasses.replace(dataset, pixels=StoredPixels(folder, dataset.mark))


def _mesh(stored: Any) -> Mesh:
    source = np.array(stored["source"], dtype=np.uint8) if "source" in stored else None
    sigma_m = np.array(stored["sigma_m"], dtype=np.float64) if "sigma_m" in stored else None
    vertices_m, faces = np.array(stored["vertices_m"], dtype=np.float64), np.array(stored["faces"], dtype=np.int64)
    return Mesh(vertices_m, faces, source, sigma_m)


def _read_view(folder: Path, name: str) -> PosedView:
    with h5py.File(folder / "views" / f"{name}.h5", "r") as file:
        K, terms = np.array(file["K"], dtype=np.float64), np.array(file["distortion"], dtype=np.float64)
        height, width = np.asarray(file["valid"]).shape
        k1, k2, p1, p2, k3, k4, k5, k6 = (float(term) for term in terms)
        camera = CameraModel(
            width, height, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]),
            k1, k2, p1, p2, k3, k4, k5, k6,
        )  # fmt: skip
        pose, covariance = np.array(file["T_world_camera"]), np.array(file["covariance"])
        device = str(file.attrs.get("camera", ""))
    return PosedView(name, ".png", camera, pose, covariance, device=device)
