"""Declares export formats, and writes a data set in one of them with what every exported folder has beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from service.core.loading import declared_kinds, kind_named
from service.dataset import card, croissant
from service.dataset.crate import METADATA, crate
from service.dataset.croissant import VIEWS_NAME, views_csv
from service.dataset.export_folder import ExportFolder, count_files, export_folder, json_bytes
from service.dataset.pixels import undistorted_data_set
from service.dataset.records import DataSet
from service.dataset.writing_views import write_views

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
    **card.BESIDE,
    card.NAME: "what this data set is, how it was made, how good it is, and what may be done with it",
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
    folder.anew(card.NAME, lambda: card.card(dataset, words, description).encode())
    folder.anew(
        croissant.NAME,
        lambda: json_bytes(croissant.croissant(dataset, words, folder.listed(), folder.parts, _DESCRIBED)),
    )
    folder.anew(METADATA, lambda: json_bytes(crate(dataset, words, folder.listed(), _DESCRIBED)))
