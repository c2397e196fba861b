"""Writes the files of an export's views in parallel, over the chosen executor, ahead of the format's writer.

The writer then finds them there, as those that an interrupted export wrote. Other processes read the data set and the
format from a file, run the same writer, and let it make the files of one view.
"""

from __future__ import annotations

import logging
import os
import pickle
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from service.core.units import megabytes
from service.dataset.export_folder import ExportFolder, ListedFiles, Part
from service.dataset.pixels import Photographs
from service.dataset.records import DataSet
from service.machine.executors import IN_THIS_PROCESS, mapping
from service.machine.resources import processes_for

if TYPE_CHECKING:
    from service.dataset.exporter import Exporter

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
