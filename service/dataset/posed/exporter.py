"""The declaration of an export format, and how a data set is written in one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from service.core.declared_kinds import declared_kinds, kind_named
from service.dataset.package.packaging import write_package
from service.dataset.posed.folder import ExportFolder, count_files, export_folder
from service.dataset.posed.pixels import undistorted_data_set
from service.dataset.posed.records import DataSet

GROUP = "orthocapture.exporters"
Progress = Callable[[str, int, int], None]  # activity, files done, files in total


@dataclass(frozen=True, slots=True)
class Exporter:
    """A format.

    Attributes:
        name: as it is named on the command line.
        words: what it is, and who reads it.
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
    """Every format by its name.

    Raises:
        ConfigurationError: two have the same name, or an entry point names something else.
    """
    return declared_kinds("service.dataset.formats", GROUP, Exporter)


def exporter(name: str) -> Exporter:
    """The format of this name.

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
) -> None:
    """Write a data set into a new folder, with what every folder has beside the format.

    Args:
        dataset: as photographed; it is undistorted here where the format needs that.
        how: the format.
        target: a new folder; it appears when it is whole.
        personal: False leaves GPS, owner and serial numbers out of resampled pictures.
        leaving: called with the list of checksums when all is written, before the folder has its name.
        progress: called with the activity, the files done and their total.

    Raises:
        DataError: the target exists, the data set does not fit into the format, or a picture cannot be read.
        ConfigurationError: another process is writing the same export.
    """
    fitting = dataset.of_first_camera if how.one_camera else dataset
    ready = undistorted_data_set(fitting, personal=personal) if how.pinhole else fitting
    identity = f"{how.name} 2 {ready.identity} {'with' if personal else 'without'} personal data"
    with export_folder(target, identity, leaving, _told(ready, how, progress)) as folder:
        _write(ready, how, folder)


def _write(dataset: DataSet, how: Exporter, folder: ExportFolder) -> None:
    """The files of the format, and those that every folder has."""
    how.write(dataset, folder)
    write_package(dataset, folder, form=how.name, words=how.words, description=how.write.__doc__ or "")


def _told(dataset: DataSet, how: Exporter, progress: Progress | None) -> Callable[[int], None]:
    """Turns a number of files into progress."""
    if progress is None:
        return lambda _count: None
    total = count_files(lambda folder: _write(dataset, how, folder))
    return lambda count: progress("writing", count, total)
