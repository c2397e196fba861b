"""What a person asked to have exported, stored beside an unfinished export so that it can go on later."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pydantic import Field, TypeAdapter, ValidationError

from service.core.errors import DataError
from service.core.records.data_set import FIRST_VERSION, VERSION, DataSetStatement
from service.dataset.export_folder import being_written, discard, interrupted

_USUAL_CROP = "1920x1080"  # as in the paper
_WANTED = ".wanted"  # ends the name of the file beside an unfinished export


@dataclass(frozen=True, slots=True)
class WantedExport:
    """A data set in a format.

    Attributes:
        form: name of the format.
        crop: `WIDTHxHEIGHT` in pixels; "" for whole images or, where several crops are wanted, for 1920x1080.
        crops: the largest number of crops of each image.
        anonymous: GPS, owner and serial numbers are left out of the pictures, people and serial numbers out of
            the metadata, and the scanner's own files out of the folder.
        stated: title, licence, ethics, creators and citation; they replace those of the protocol.
        version: the data set's version, MAJOR.MINOR.PATCH.
    """

    form: str
    crop: str = ""
    crops: Annotated[int, Field(ge=1, le=16)] = 1
    anonymous: bool = False
    stated: DataSetStatement = field(default_factory=DataSetStatement)
    version: Annotated[str, Field(pattern=VERSION)] = FIRST_VERSION

    @property
    def crop_px(self) -> str:
        """`WIDTHxHEIGHT` of the crops; "" for whole images."""
        return self.crop or (_USUAL_CROP if self.crops > 1 else "")

    @property
    def words(self) -> str:
        """The format and its options."""
        crops = f", up to {self.crops} of each image" if self.crops > 1 else ""
        cut = f", crops of {self.crop_px.replace('x', ' × ')} px{crops}" if self.crop_px else ""
        return f"{self.form}{cut}{', anonymous' if self.anonymous else ''}"


@dataclass(frozen=True, slots=True)
class ExportRequest:
    """A person's request for an export of a run."""

    run_id: str
    wanted: WantedExport
    by: str
    at_utc: str


@dataclass(frozen=True, slots=True)
class UnfinishedExport:
    """An export that was started and has not ended; `writing`: a process is at it."""

    name: str
    request: ExportRequest
    writing: bool


_REQUEST = TypeAdapter(ExportRequest)


def keep_request(target: Path, request: ExportRequest) -> None:
    """Write the request beside the folder that it is for."""
    path = _path(target)
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    part.write_bytes(_REQUEST.dump_json(request))
    part.replace(path)


def kept_request(target: Path) -> ExportRequest:
    """Return the request beside a folder.

    Raises:
        DataError: there is none that can be read.
    """
    try:
        return _REQUEST.validate_json(_path(target).read_bytes())
    except (OSError, ValidationError) as error:
        raise DataError(
            "the record of what was to be exported is lost", where=target.name, remedy="Start the export again"
        ) from error


def forget_request(target: Path) -> None:
    """Remove the request, unless there is an unfinished export that it belongs to."""
    if not interrupted(target):
        _path(target).unlink(missing_ok=True)


def discard_unfinished(target: Path) -> None:
    """Remove an unfinished export and its request. Raises DataError, and ConfigurationError while it is written."""
    discard(target)
    forget_request(target)


def unfinished_exports(folder: Path, run_id: str) -> list[UnfinishedExport]:
    """Return the unfinished exports of a run in a folder of exports, the newest first."""
    found: list[UnfinishedExport] = []
    for path in sorted(folder.glob(f".{run_id}*{_WANTED}"), reverse=True):
        target = folder / path.name.removeprefix(".").removesuffix(_WANTED)
        try:
            request = kept_request(target)
        except DataError:
            continue  # no export of ours
        if request.run_id == run_id and interrupted(target):
            found.append(UnfinishedExport(target.name, request, being_written(target)))
    return found


def _path(target: Path) -> Path:
    return target.with_name(f".{target.name}{_WANTED}")
