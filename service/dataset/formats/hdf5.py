"""HDF5 for training: arrays that need nothing but numpy and h5py, and a loader of forty lines beside them."""

from __future__ import annotations

import importlib.resources
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from service.dataset.export_folder import ExportFolder, Part
from service.dataset.exporter import Exporter
from service.dataset.records import DataSet, PosedView

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
