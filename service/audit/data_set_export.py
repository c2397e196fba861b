"""The export of a run's data set in a format that others read, for the command line and the pages alike."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from service.audit.background import Progress
from service.audit.bundle import record_export, require_exportable
from service.audit.exports import WantedExport
from service.audit.recorded_run import not_in_yet, read_run
from service.core.errors import ConfigurationError
from service.core.gates import refuse_data_set
from service.core.records.data_set import VERSION
from service.dataset.exporter import Exporter, exporter, write_data_set
from service.dataset.pixels import cropped_data_set, undistorted_data_set
from service.dataset.records import DataSet
from service.dataset.run_data_set import data_set_of, specimen_pixels
from service.dataset.summary import RunSummary
from service.store.disk_space import require_export_space
from service.store.store import Store

_SIZE = re.compile(r"([1-9]\d{0,5})x([1-9]\d{0,5})")


def export_data_set(
    store: Store, run_id: str, wanted: WantedExport, target: Path, actor: str, progress: Progress
) -> DataSet:
    """Write a completed run's data set into a new folder, and record the export. Returns what was written.

    Args:
        store: the data folder.
        run_id: the run.
        wanted: format and options.
        target: the folder, which appears when it is whole. An interrupted export goes on.
        actor: the person who exports.
        progress: a function that is called with the activity, the amount done and the total.

    Raises:
        ConfigurationError: there is no such format or crop, or another process writes this folder.
        IntegrityError: the evidence does not verify. Nothing was written.
        IllegalTransitionError: the run is not complete or not released. Nothing was written.
        SpaceShortError: it would use the space that is reserved for the evidence. Nothing was written.
        DataError: the folder exists, or the run does not have what the format needs.
    """
    how, size = exporter(wanted.form), crop_size(wanted.crop_px)
    require_version(wanted.version)
    require_export_space(store, run_id, target)
    require_exportable(store, run_id, progress)
    recorded = read_run(store.database_path.parent, run_id)
    refusal = refuse_data_set(recorded.state)
    if refusal is not None:
        raise refusal
    progress("reading the run", 0, 0)
    missing = not_in_yet(recorded.protocol, recorded.state, recorded.events)
    summary, personal = recorded.summary(), not wanted.anonymous
    dataset = data_set_of(summary, missing, personal=personal, stated=wanted.stated, version=wanted.version)
    if size is not None:
        progress("choosing crops", 0, 0)
        dataset = _cropped(dataset, summary, how, size, wanted)

    def leaving(sums: Path) -> None:
        head_sha256 = recorded.events[-1].sha256
        named = {"file_name": target.name, "what": "dataset", "head_sha256": head_sha256}
        record_export(store, run_id, sums, **named, actor=actor)

    write_data_set(dataset, how, target, personal=personal, leaving=leaving, progress=progress)
    return dataset


def crop_size(text: str) -> tuple[int, int] | None:
    """Return the width and height of `WIDTHxHEIGHT`; None for "", which is whole images.

    Raises:
        ConfigurationError: it is not a size.
    """
    if not text:
        return None
    found = _SIZE.fullmatch(text)
    if found is None:
        raise ConfigurationError(
            f"{text!r} is not a size", where="--crop", remedy="Give width and height, such as 1920x1080"
        )
    return int(found[1]), int(found[2])


def require_version(version: str) -> None:
    """Raise ConfigurationError unless it is a version such as 1.0.0."""
    if not re.match(VERSION, version):
        raise ConfigurationError(
            f"{version!r} is not a version", where="--data-version", remedy="Give three numbers, such as 1.0.0"
        )


def _cropped(
    dataset: DataSet, summary: RunSummary, how: Exporter, size: tuple[int, int], wanted: WantedExport
) -> DataSet:
    """Return parts of the pictures as the format has them: undistorted ones are cut after they were undistorted."""
    personal = not wanted.anonymous
    whole = undistorted_data_set(dataset, personal=personal) if how.pinhole else dataset
    return cropped_data_set(whole, partial(specimen_pixels, summary), size, most=wanted.crops, personal=personal)
