"""Exports that people request in the browser: request, process, formats to choose, downloads as zip files."""

from __future__ import annotations

import hashlib
import io
import os
import re
import stat
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from threading import Lock
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, TypeAdapter, ValidationError

from service.audit.background import ChildProcesses, ChildState, Progress, report
from service.audit.bundle import marked_name
from service.core.errors import DataError, IllegalTransitionError, IntegrityError
from service.core.records.data_set import FIRST_VERSION, VERSION, DataSetStatement
from service.core.records.events import Event
from service.core.records.run_events import EvidenceExported
from service.dataset.export_folder import SUMS, being_written, discard, interrupted
from service.store.durable_effects import Clock, utc_text

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

# --- what a person asked to have exported, stored beside an unfinished export so that it can go on ----------------

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


# --- exports under way, and downloads -----------------------------------------------------------------------------

_OLDEST = (1980, 1, 1, 0, 0, 0)  # the earliest time in zip; the files state their own dates
_CHUNK = 1 << 20
_TEXT = frozenset({".json", ".txt", ".csv", ".md", ".xml", ".ply", ".py"})  # others are compressed already


class _Sent(io.RawIOBase):
    """A write-only file for zipfile; `take` removes and returns the bytes written since the last call."""

    def __init__(self) -> None:
        self._kept = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, data: ReadableBuffer, /) -> int:
        view = memoryview(data).cast("B")
        self._kept += view
        return len(view)

    def take(self) -> bytes:
        taken = bytes(self._kept)
        self._kept.clear()
        return taken


def zip_chunks(folder: Path, sums_sha256: str) -> Iterator[bytes]:
    """Yield the bytes of the zip file: the files that SHA256SUMS lists, and SHA256SUMS last.

    Args:
        folder: an exported data set.
        sums_sha256: recorded hash of its list of checksums.

    Raises:
        IntegrityError: the list is not the recorded one, or a file is not the listed one: the transfer breaks off.
    """
    sums = (folder / SUMS).read_bytes()
    if hashlib.sha256(sums).hexdigest() != sums_sha256:
        raise _altered(SUMS)
    sent = _Sent()
    with zipfile.ZipFile(sent, "w", allowZip64=True) as archive:
        for line in sums.decode().splitlines():
            sha256, _, name = line.partition("  ")
            yield from _entry(archive, sent, folder, name, sha256)
        with archive.open(_info(f"{folder.name}/{SUMS}"), "w") as entry:
            entry.write(sums)
    yield sent.take()


def _entry(archive: zipfile.ZipFile, sent: _Sent, folder: Path, name: str, sha256: str) -> Iterator[bytes]:
    """Yield one file, read without following links."""
    inside = PurePosixPath(name)
    if inside.is_absolute() or ".." in inside.parts:
        raise _altered(name)
    digest = hashlib.sha256()
    try:
        opened = os.open(folder / inside, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError as error:
        raise _altered(name) from error
    with (
        os.fdopen(opened, "rb") as file,
        archive.open(_info(f"{folder.name}/{name}"), "w", force_zip64=True) as entry,
    ):
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
            entry.write(chunk)
            yield sent.take()
    if digest.hexdigest() != sha256:
        raise _altered(name)


def _info(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name, date_time=_OLDEST)
    info.compress_type = zipfile.ZIP_DEFLATED if PurePosixPath(name).suffix in _TEXT else zipfile.ZIP_STORED
    info.external_attr = 0o100644 << 16
    return info


def _altered(name: str) -> IntegrityError:
    return IntegrityError("a file of the export is not as it was written", where=name, remedy="Export again")


FOLDER = "exports"
FORMAT = "format"  # instead of a What: the data set in a format
What = Literal["bundle", "hashes", "dataset", "report", "report_pdf"]
_UNSAFE = re.compile(r"[^0-9A-Za-z_-]+")
_SUFFIX: dict[What, str] = {
    "bundle": "bundle.zip",
    "hashes": "bundle-hashes.zip",
    "dataset": "dataset.zip",
    "report": "report.html",
    "report_pdf": "report.pdf",
}


@dataclass(frozen=True, slots=True)
class ExportedFile:
    """A recorded export, and whether its file still exists."""

    seq: int
    at_utc: str
    actor: str
    record: EvidenceExported
    present: bool


class Exports:
    """The exports of a data folder in a web process; one at a time for each run."""

    def __init__(self, data: Path, clock: Clock) -> None:
        self._data = data
        self._clock = clock
        self._children = ChildProcesses("service.audit.export_process", "export", clock)
        self._starting = Lock()

    @property
    def folder(self) -> Path:
        """The folder of the exported files."""
        return self._data / FOLDER

    def state(self, run_id: str) -> ChildState | None:
        """Return the state of a run's present or last export; its result is the file's name.

        None before the first.
        """
        return self._children.state(run_id)

    def start(self, run_id: str, export: What, by: str) -> None:
        """Start an export. Raises IllegalTransitionError while another export of the run is running."""
        self.folder.mkdir(exist_ok=True)
        self._start(run_id, export, self.folder / f"{self._name(run_id)}-{_SUFFIX[export]}", by)

    def start_format(self, run_id: str, wanted: WantedExport, by: str, *, simulated: bool) -> None:
        """Start an export of the data set in a format. Raises IllegalTransitionError as `start` does."""
        self.folder.mkdir(exist_ok=True)
        options = (
            _UNSAFE.sub("_", wanted.form)[:40],
            f"{wanted.crop_px}x{wanted.crops}" if wanted.crop_px else "",
            "anonymous" if wanted.anonymous else "",
        )
        name = "-".join((self._name(run_id), *filter(None, options)))
        target = self.folder / marked_name(name, simulated=simulated)
        request = ExportRequest(run_id, wanted, by, utc_text(self._clock.utc_now()))
        self._start(run_id, FORMAT, target, by, request)

    def go_on(self, run_id: str, name: str, by: str) -> None:
        """Go on with an unfinished export. Raises DataError for any other name, IllegalTransitionError as `start`."""
        self._start(run_id, FORMAT, self._unfinished(run_id, name), by)

    def discard(self, run_id: str, name: str) -> None:
        """Remove an unfinished export. Raises DataError for another name, ConfigurationError while it is written."""
        discard_unfinished(self._unfinished(run_id, name))

    def stop(self, run_id: str) -> bool:
        """Stop the running export; what a format has written so far stays. Returns whether there was one."""
        return self._children.stop(run_id)

    def wait(self, run_id: str, timeout_s: float) -> None:
        """Wait until the present export has ended."""
        self._children.wait(run_id, timeout_s)

    def unfinished(self, run_id: str) -> list[UnfinishedExport]:
        """Return exports in a format that were started and have not ended, newest first."""
        return unfinished_exports(self.folder, run_id)

    def files(self, events: Sequence[Event]) -> list[ExportedFile]:
        """Return every export of a run, newest first."""
        found = [
            ExportedFile(e.seq, e.at_utc, e.actor, e.payload, self._path(e.payload) is not None)
            for e in events
            if isinstance(e.payload, EvidenceExported)
        ]
        return found[::-1]

    def path(self, events: Sequence[Event], file_name: str) -> tuple[Path, EvidenceExported]:
        """Return a file or folder for download, by its recorded name. Raises DataError for any other name."""
        for file in self.files(events):
            path = self._path(file.record) if file.record.file_name == file_name else None
            if path is not None:
                return path, file.record
        raise DataError(
            "no exported file of this run has this name here",
            where=file_name[:200],
            remedy="Choose one of the list, or export again",
        )

    def _path(self, record: EvidenceExported) -> Path | None:
        """Return the file, or a data set's folder, if it exists with the recorded size (of its list of checksums).

        Names that lead out of the folder are refused, and so are links.
        """
        path = self.folder / record.file_name
        if path.parent != self.folder or path.name != record.file_name:
            return None
        try:
            found = path.lstat()
            if stat.S_ISDIR(found.st_mode):
                found = (path / SUMS).lstat()
        except OSError:
            return None
        return path if stat.S_ISREG(found.st_mode) and found.st_size == record.size_bytes else None

    def _name(self, run_id: str) -> str:
        return f"{run_id}-exported-{self._clock.utc_now():%Y%m%d-%H%M%S}"

    def _unfinished(self, run_id: str, name: str) -> Path:
        found = next((export.name for export in self.unfinished(run_id) if export.name == name), None)
        if found is None:
            raise DataError(
                "no unfinished export of this run has this name",
                where=name[:200],
                remedy="Choose one of the list, or export again",
            )
        return self.folder / found

    def _start(self, run_id: str, export: str, target: Path, by: str, request: ExportRequest | None = None) -> None:
        """Start an export unless one is running, and keep the request that its process reads."""
        with self._starting:
            now = self._children.state(run_id)
            if now is not None and now.pending:
                raise IllegalTransitionError(
                    f"{now.by} is exporting this run already", where=run_id, remedy="Wait until that one is ready"
                )
            if request is not None:  # not before: one that runs may have the same name, which tells seconds
                keep_request(target, request)
            words = [str(self._data), run_id, export, str(target), by]
            self._children.start(run_id, words, by=by, tidy=lambda: forget_request(target))


# The registered formats, listed by a process of its own: they load the numerics, which a web process does without.
#
# `python -m service.audit.exports`


_KEY = ""  # the list belongs to no run


@dataclass(frozen=True, slots=True)
class Format:
    """A format: its name, and a text on what it is."""

    name: str
    words: str


class Formats:
    """The formats that this installation has."""

    def __init__(self, clock: Clock) -> None:
        self._children = ChildProcesses("service.audit.exports", "list of formats", clock)

    def state(self) -> ChildState | None:
        """Return the progress or the outcome of the listing; None before it was started."""
        return self._children.state(_KEY)

    def known(self, wait_s: float = 0.0) -> tuple[Format, ...]:
        """Return the formats in the order of their names; empty while they are not known.

        Begins to list them once.
        """
        if self.state() is None:
            self._children.start(_KEY, (), by="")
        if wait_s:
            self._children.wait(_KEY, wait_s)
        now = self.state()
        return tuple(Format(**row) for row in (now.result or () if now else ()))


def listed(_progress: Progress) -> list[dict[str, str]]:
    """Return the formats as plain data. Raises ConfigurationError."""
    from service.dataset.exporter import exporters  # noqa: PLC0415 - see above

    return [{"name": name, "words": how.words} for name, how in sorted(exporters().items())]


if __name__ == "__main__":
    report(listed, outlives_parent=False)
