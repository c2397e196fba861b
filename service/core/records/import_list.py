"""The file list of an import: every imported file with its hash, and what was left out and why."""

from __future__ import annotations

from typing import Any, Literal

from service.core.errors import DataError
from service.core.records.base import Record
from service.core.records.run_events import RecordedOptics, recorded_optics

PhotographRole = Literal["calibration", "image", "control_image"]
FileRole = Literal["scan", "control_scan", "ct"]


class ImportedFile(Record):
    """One file as it was when listed. `path` is relative to the import's folder, or absolute if outside it."""

    path: str
    sha256: str
    size_bytes: int
    modified_utc: str
    media_type: str = "application/octet-stream"


class ImportedView(Record):
    """One photograph with the raw files of the same exposure and its metadata."""

    name: str
    role: PhotographRole
    photograph: ImportedFile
    raws: tuple[ImportedFile, ...] = ()
    camera: dict[str, Any]  # as its EXIF states it; read by `optics`

    @property
    def optics(self) -> RecordedOptics:
        """Return what the photograph states of its camera, lens and settings."""
        return recorded_optics(self.camera)


class LeftOutFile(Record):
    """A file of the folder that is not imported."""

    path: str
    reason: str


class ImportList(Record):
    """The contents of an import. The same folder gives the same list, which identifies an interrupted import."""

    folder: str
    views: tuple[ImportedView, ...]
    files: dict[FileRole, tuple[ImportedFile, ...]]
    left_out: tuple[LeftOutFile, ...] = ()

    def of(self, role: PhotographRole) -> tuple[ImportedView, ...]:
        """Return the photographs with this role, in order."""
        return tuple(view for view in self.views if view.role == role)

    def holds(self, role: PhotographRole | FileRole) -> bool:
        """Return whether the list has anything with this role."""
        return any(view.role == role for view in self.views) or any(name == role for name in self.files)

    def all_files(self) -> tuple[ImportedFile, ...]:
        """Return every file to be imported."""
        photographs = [file for view in self.views for file in (view.photograph, *view.raws)]
        return (*photographs, *(file for files in self.files.values() for file in files))

    def check(self, path: str, sha256: str) -> ImportedFile:
        """Return the list's entry for a file that is being imported.

        Raises DataError if the file is not in the list, or if its bytes have changed since it was listed.
        """
        found = next((file for file in self.all_files() if self.absolute(file) == path), None)
        if found is None:
            raise DataError(
                "the file is not in the list of the import", where=path, remedy="Begin a new import of this folder"
            )
        if found.sha256 != sha256:
            raise DataError(
                "the file has changed since it was listed",
                where=path,
                remedy="Restore it and resume the run, or begin a new import",
            )
        return found

    def absolute(self, file: ImportedFile) -> str:
        """Return the absolute path of a file."""
        return file.path if file.path.startswith("/") else f"{self.folder}/{file.path}"


def imported_sentence(at_utc: str, by: str) -> str:
    """Return the sentence with which every page and report on an imported run begins."""
    when = f"{at_utc[:16].replace('T', ' ')} UTC"
    return f"The photographs were imported on {when} by {by}; how the images were captured is not in evidence"
