"""A driver in a package of its own: a scanner whose software delivers each scan as one ZIP file in a folder."""

from __future__ import annotations

import zipfile
from importlib.metadata import version
from pathlib import Path

from pydantic import Field

from drivers.errors import DeviceUnavailableError, IncompleteExportError, UnreadableFileError
from drivers.interfaces import DeviceIdentity, DeviceReport, ScanExport, ScannedMesh
from drivers.meshes.mesh_file import MESH_SUFFIXES, MeshUnit, export_of, read_mesh_file
from drivers.plugin import DriverConfig, DriverSpec


class ZippedScansConfig(DriverConfig):
    """The scanner's section in rig.yaml."""

    folder: Path = Field(description="where the ZIP files appear")
    path: Path = Field(description="an empty folder of our own, into which they are unpacked")
    unit: MeshUnit = Field(default="auto", description="of the coordinates: mm, m, or auto (from the size)")


class ZippedScans:
    """drivers.interfaces.Scanner on a folder of ZIP files, which it reads but never changes."""

    def __init__(self, config: ZippedScansConfig) -> None:
        self._config = config

    def open(self) -> DeviceIdentity:
        """Check that the folder exists; raises DeviceUnavailableError if it does not."""
        self._archives()
        return self._identity()

    def close(self) -> None:
        """Do nothing: nothing is kept open."""

    def report(self) -> DeviceReport:
        """Return what `orthocapture doctor` and the record of a run say of the device."""
        archives = self._archives()
        cut_off = tuple(f"{one.name}: still being written, or damaged" for one in archives if not _is_whole(one))
        return DeviceReport(self._identity(), details={"archives": str(len(archives))}, problems=cut_off)

    def exports(self) -> tuple[ScanExport, ...]:
        """The complete scans, oldest first. A ZIP file has its index at the end: without it, it is not complete."""
        whole = [one for one in self._archives() if _is_whole(one)]
        return tuple(self._unpacked(one) for one in sorted(whole, key=lambda one: one.stat().st_mtime_ns))

    def read(self, export: ScanExport) -> ScannedMesh:
        """The mesh, in metres. Raises UnreadableFileError, IncompleteExportError."""
        return read_mesh_file(export.files[0], self._config.unit, export=export)

    def _archives(self) -> list[Path]:
        try:
            return sorted(one for one in self._config.folder.iterdir() if one.suffix.lower() == ".zip")
        except OSError as error:
            raise DeviceUnavailableError(
                f"the folder cannot be read ({error.strerror})",
                where=str(self._config.folder),
                remedy="Mount the share, or correct the folder in rig.yaml",
            ) from error

    def _unpacked(self, archive: Path) -> ScanExport:
        target = self._config.path / archive.stem
        try:
            with zipfile.ZipFile(archive) as opened:
                opened.extractall(target)
        except (OSError, zipfile.BadZipFile) as error:
            raise IncompleteExportError(
                f"the archive cannot be unpacked ({error})", where=str(archive), remedy="Export the scan again"
            ) from error
        meshes = [one for one in sorted(target.rglob("*")) if one.suffix.lower() in MESH_SUFFIXES]
        if len(meshes) != 1:
            raise UnreadableFileError(
                f"{len(meshes)} meshes in one archive", where=str(archive), remedy="Export one scan at a time"
            )
        return export_of(meshes[0])

    def _identity(self) -> DeviceIdentity:
        return DeviceIdentity(
            kind="scanner",
            model="ZIP folder",
            serial="",
            firmware="",
            driver="zipped_scans",
            driver_version=version("orthocapture-zipped-scans"),
            address=str(self._config.folder),
        )


def _is_whole(archive: Path) -> bool:
    return zipfile.is_zipfile(archive)


DRIVER = DriverSpec(kind="scanner", config=ZippedScansConfig, build=ZippedScans)
