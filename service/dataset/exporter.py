"""Declares export formats, and writes a data set in one of them, its views in parallel and what every export has."""

from __future__ import annotations

import logging
import os
import pickle
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.images.resample import described
from service.compute.surfaces.surface import ply_bytes
from service.core.errors import DataError
from service.core.geometry import Array
from service.core.loading import declared_kinds, kind_named
from service.core.units import megabytes
from service.dataset.crate import METADATA, crate
from service.dataset.descriptions import BESIDE, CARD_NAME, CROISSANT_NAME, VIEWS_NAME, card, croissant, views_csv
from service.dataset.export_folder import ExportFolder, ListedFiles, Part, count_files, export_folder, json_bytes
from service.dataset.pixels import Photographs, undistorted_data_set
from service.dataset.records import DataSet, Mesh
from service.machine.executors import IN_THIS_PROCESS, mapping
from service.machine.resources import processes_for


def ply(vertices: Array, faces: NDArray[np.int64], comment: str) -> bytes:
    """Return a binary PLY with vertices (V, 3) in double precision and faces (F, 3), in the vertices' own unit."""
    columns = {name: vertices[:, k].astype("<f8") for k, name in enumerate("xyz")}
    return ply_bytes(columns, faces, [comment] if comment else [])


def ground_truth_ply(mesh: Mesh, comment: str) -> bytes:
    """Return a binary PLY of the ground truth in metres, with `source` and `sigma_m` of each vertex if known."""
    columns: dict[str, NDArray[np.generic]] = {
        name: mesh.vertices_m[:, k].astype("<f8") for k, name in enumerate("xyz")
    }
    comments = [comment] if comment else []
    if mesh.source is not None and mesh.sigma_m is not None:
        columns |= {"source": mesh.source.astype(np.uint8), "sigma_m": mesh.sigma_m.astype("<f4")}
        comments.append("source 0: CT, 1: scan, 2: blend; sigma along the normal")
    return ply_bytes(columns, mesh.faces, comments)


def png(image: NDArray[np.uint8] | NDArray[np.uint16], mark: str = "") -> bytes:
    """Return a PNG of (H, W) grey, (H, W, 3) BGR or (H, W, 4) BGRA values; a mark is its description.

    Raises:
        DataError: it cannot be encoded.
    """
    encoded, data = cv2.imencode(".png", image)
    if not encoded:
        raise DataError("an image cannot be encoded as PNG", remedy="Export at a lower resolution")
    return described(data.tobytes(), mark) if mark else data.tobytes()


def mask_png(mask: NDArray[np.bool_], mark: str) -> bytes:
    """Return a PNG with 255 where the mask (H, W) is true and 0 elsewhere."""
    return png(np.where(mask, np.uint8(255), np.uint8(0)), mark)


# Writes the files of an export's views in parallel, over the chosen executor, ahead of the format's writer.
#
# The writer then finds them there, as those that an interrupted export wrote. Other processes read the data set and
# the format from a file, run the same writer, and let it make the files of one view.


_log = logging.getLogger(__name__)
_FEWEST_PIXELS = 40e6  # that are worth further processes: about ten seconds
_BYTES_A_PIXEL = 30  # colours, depth, normals and masks of a view
_BYTES_A_FACE = 300  # of the mesh, with its tree for rays


@dataclass(frozen=True, slots=True)
class _ViewTask:
    """The task of making the files of one view.

    Attributes:
        data_file: the file of the data set and the format.
        photographs: the files that the data set reads for the view, which find their way with the task.
        root: the folder of the export.
        view: the name of the view.
    """

    data_file: Path
    photographs: tuple[Path, ...]
    root: Path
    view: str


def write_views(
    dataset: DataSet, how: Exporter, folder: ExportFolder, report: Callable[[int], None], processes: int | None = None
) -> None:
    """Write the files that belong to views, where that is worth it; nothing otherwise.

    Args:
        dataset: the data set as the format gets it.
        how: the format.
        folder: the folder that is filled.
        report: a function that is called with the number of files that are there.
        processes: number of processes of this machine; None: as many as are worth it.
    """
    listed = ListedFiles()
    how.write(dataset, listed)
    files = listed.of_views
    missing = [name for name, names in files.items() if not all(folder.has(file) for file in names)]
    if processes is None:
        copies = isinstance(dataset.pixels, Photographs) and set(listed.parts) <= {"image"}
        processes = IN_THIS_PROCESS if copies else _processes_worth(dataset, set(missing))
    if processes == IN_THIS_PROCESS or len(missing) < 2:
        return
    try:
        data = pickle.dumps((dataset, how), protocol=pickle.HIGHEST_PROTOCOL)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        _log.info("the data set cannot be given to other processes, this one writes it: %s", error)
        return
    with tempfile.TemporaryDirectory(prefix="orthocapture-export-") as scratch:
        data_file = Path(scratch) / "data_set"
        data_file.write_bytes(data)
        views = {view.name: view for view in dataset.views}
        tasks = [_ViewTask(data_file, dataset.pixels.files(views[name]), folder.root, name) for name in missing]
        done = sum(len(names) for name, names in files.items() if name not in missing)
        with mapping(processes, len(tasks)) as map_over:
            for count in map_over(_write_view, tasks):
                done += count
                report(done)
        _read.cache_clear()


def _processes_worth(dataset: DataSet, views: set[str]) -> int:
    """Return how many processes of this machine the computation of these views is worth."""
    pixels = [view.camera.width * view.camera.height for view in dataset.views if view.name in views]
    if sum(pixels) < _FEWEST_PIXELS:
        return IN_THIS_PROCESS
    each = max(pixels) * _BYTES_A_PIXEL + len(dataset.mesh.faces) * _BYTES_A_FACE
    return processes_for(len(pixels), megabytes(each))


class _OneView(ExportFolder):
    """Writes the files of one view alone."""

    def __init__(self, root: Path, view: str) -> None:
        # Another process may still write the same file for an export that was interrupted.
        super().__init__(root, suffix=f".{os.getpid()}")
        self._view = view
        self.count = 0

    def written_by(self, name: str, write: Callable[[Path], object], part: Part | None = None) -> None:
        """Write the file if it is one of the view."""
        if part is not None and part.view == self._view:
            super().written_by(name, write, part)
            self.count += 1


def _write_view(task: _ViewTask) -> int:
    """Write the files of a view; returns their number."""
    dataset, how = _read(task.data_file)
    folder = _OneView(task.root, task.view)
    how.write(dataset, folder)
    return folder.count


@lru_cache(maxsize=1)
def _read(data_file: Path) -> tuple[DataSet, Exporter]:
    """Return the data set and the format of a file, whose path never recurs.

    It is held, so that the mesh's tree for rays is built once.
    """
    dataset, how = pickle.loads(data_file.read_bytes())
    return dataset, how


GROUP = "orthocapture.exporters"
Progress = Callable[[str, int, int], None]  # activity, files done, files in total


@dataclass(frozen=True, slots=True)
class Exporter:
    """An export format.

    Attributes:
        name: the format's name on the command line.
        words: a few words on the format and who reads it.
        write: puts the files of a data set into a folder; units and frames are stated in its docstring.
        pinhole: the format has no distortion, so it gets undistorted images.
        one_camera: the format has one camera, so it gets only the images of the rig's first one.
    """

    name: str
    words: str
    write: Callable[[DataSet, ExportFolder], None]
    pinhole: bool = False
    one_camera: bool = False


def exporters() -> dict[str, Exporter]:
    """Return every format by its name.

    Raises:
        ConfigurationError: two have the same name, or an entry point names something else.
    """
    return declared_kinds("service.dataset.formats", GROUP, Exporter)


def exporter(name: str) -> Exporter:
    """Return the format of this name.

    Raises:
        ConfigurationError: there is none.
    """
    return kind_named(name, exporters(), what="format", option="--format")


def write_data_set(
    dataset: DataSet,
    how: Exporter,
    target: Path,
    *,
    personal: bool = True,
    leaving: Callable[[Path], None] = lambda _sums: None,
    progress: Progress | None = None,
    processes: int | None = None,
) -> None:
    """Write a data set into a new folder, with what every folder has beside the format.

    Args:
        dataset: the data set as photographed; it is undistorted here where the format needs that.
        how: the format.
        target: a new folder; it appears when it is whole.
        personal: False leaves GPS, owner and serial numbers out of resampled pictures.
        leaving: a function called with the list of checksums when all is written, before the folder has its name.
        progress: a function that is called with the activity, the files done and their total.
        processes: number of processes of this machine that write the views' files; None: as many as are worth it.

    Raises:
        DataError: the target exists, the data set does not fit into the format, or a picture cannot be read.
        ConfigurationError: another process is writing the same export.
    """
    fitting = dataset.of_first_camera if how.one_camera else dataset
    ready = undistorted_data_set(fitting, personal=personal) if how.pinhole else fitting
    identity = f"{how.name} 2 {ready.identity} {'with' if personal else 'without'} personal data"
    report = _told(ready, how, progress)
    with export_folder(target, identity, leaving, report) as folder:
        write_views(ready, how, folder, report, processes)
        _write(ready, how, folder)


def _write(dataset: DataSet, how: Exporter, folder: ExportFolder) -> None:
    """Write the files of the format, and those that every folder has."""
    how.write(dataset, folder)
    write_package(dataset, folder, form=how.name, words=how.words, description=how.write.__doc__ or "")


def _told(dataset: DataSet, how: Exporter, progress: Progress | None) -> Callable[[int], None]:
    """Return a function that turns a number of files into progress."""
    if progress is None:
        return lambda _count: None
    total = count_files(lambda folder: _write(dataset, how, folder))
    most = 0

    def report(count: int) -> None:
        nonlocal most
        most = max(most, count)  # the format's writer counts again what was written ahead of it
        progress("writing", most, total)

    return report


_DESCRIBED = {
    **BESIDE,
    CARD_NAME: "what this data set is, how it was made, how good it is, and what may be done with it",
}


def write_package(dataset: DataSet, folder: ExportFolder, *, form: str, words: str, description: str) -> None:
    """Write dataset.json, splits.json, views.csv, data card, Croissant and RO-Crate, after the format's files.

    They are written again when an interrupted export goes on, because they depend on the whole record.

    Args:
        dataset: the data set as the format got it.
        folder: the folder with the files of the format.
        form: the format's name.
        words: the format in a few words.
        description: the docstring of its writer, which explains its files.
    """
    about = {"format": form, "version": dataset.about.version, "simulated": dataset.simulated}
    folder.anew("dataset.json", lambda: json_bytes({**dataset.statement, **about}))
    folder.anew("splits.json", lambda: json_bytes({"simulated": dataset.simulated, **dataset.splits.named()}))
    folder.anew(VIEWS_NAME, lambda: views_csv(dataset, folder.parts))
    folder.anew(CARD_NAME, lambda: card(dataset, words, description).encode())
    folder.anew(
        CROISSANT_NAME,
        lambda: json_bytes(croissant(dataset, words, folder.listed(), folder.parts, _DESCRIBED)),
    )
    folder.anew(METADATA, lambda: json_bytes(crate(dataset, words, folder.listed(), _DESCRIBED)))
