"""Driver for a hand scanner, through the folder into which its software exports meshes or single views."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path

from pydantic import Field, field_validator

from drivers.errors import DeviceUnavailableError, IncompleteExportError
from drivers.interfaces import DeviceAnswers, DeviceIdentity, DeviceReport, ScanExport, ScannedMesh
from drivers.interfaces.answers import answers_of_headers
from drivers.meshes.export_watch import ExportWatch, mesh_files
from drivers.meshes.foreign_text import name_of
from drivers.meshes.header_lines import header_lines
from drivers.meshes.mesh_file import MESH_SUFFIXES, MeshUnit, read_mesh_file
from drivers.plugin import DriverConfig, DriverSpec
from drivers.scan_profiles import profile_named
from drivers.scan_profiles.profile import ScanProfile
from drivers.scan_profiles.reading import check_export, read_export

_MOST_HEADERS = 20  # in a recording of devices
# What scanners' programs write, their own projects among it.
_SURFACES = (*MESH_SUFFIXES, ".e57", ".asc", ".xyz", ".pcd", ".ptx", ".wrl", ".3mf", ".zdf", ".praw")


class ScanFolderConfig(DriverConfig):
    """The scanner's section in rig.yaml."""

    folder: Path = Field(description="folder into which the scanner's software exports")
    profile: str = Field(
        default="",
        description="the scanner that exports, such as artec_leo or zivid; empty: a mesh of any scanner",
    )
    unit: MeshUnit = Field(
        default="auto",
        description="unit of the exported coordinates: mm, m, or auto (the profile's; without one, from the size)",
    )
    only: str = Field(default="", description="file name of the only export to use; empty: use all exports")
    stable_s: float = Field(default=10.0, ge=0, description="how long an export must stay unchanged; 10 s on a share")

    @field_validator("profile")
    @classmethod
    def _installed(cls, name: str) -> str:
        if name:
            profile_named(name)
        return name


class ScanFolder:
    """drivers.interfaces.Scanner on a folder, which it polls and reads but never changes."""

    def __init__(self, config: ScanFolderConfig, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._config = config
        self._profile: ScanProfile | None = None
        self._watch = ExportWatch(config.folder, config.stable_s, monotonic)
        if config.profile:
            self._profile = profile_named(config.profile)
            check = partial(check_export, self._profile)
            self._watch = ExportWatch(
                config.folder, config.stable_s, monotonic, suffixes=self._profile.suffixes, check=check
            )

    def open(self) -> DeviceIdentity:
        """Check that the folder exists and start watching it; raises DeviceUnavailableError if it does not."""
        require_folder(self._config.folder)
        self._watch.poll()
        return self._identity()

    def close(self) -> None:
        """Do nothing: nothing is kept open."""

    def report(self) -> DeviceReport:
        """Return the free space, the number of exports, and as problems those that cannot be used."""
        require_folder(self._config.folder)
        found = self._watch.poll()
        return DeviceReport(
            identity=self._identity(),
            free_bytes=free_bytes(self._config.folder),
            details={
                "exports": str(len(found.complete)),
                "arriving": str(found.arriving),
                **self._expected(),
                "stable_s": f"{self._config.stable_s:g}",
            },
            problems=found.problems + self._foreign(),
        )

    def answers(self) -> DeviceAnswers:
        """The headers of the newest files that a scanner may have exported, complete or not."""
        require_folder(self._config.folder)
        files = sorted(mesh_files(self._config.folder, _SURFACES), key=_modified_ns)
        return answers_of_headers(map(header_lines, files[-_MOST_HEADERS:]))

    def exports(self) -> tuple[ScanExport, ...]:
        """Return the complete exports that this driver has seen unchanged for `stable_s`, oldest first."""
        require_folder(self._config.folder)
        return tuple(one for one in self._watch.poll().complete if self._config.only in ("", one.name))

    def read(self, export: ScanExport) -> ScannedMesh:
        """Read one export, in metres.

        Raises IncompleteExportError if a file of it has gone, and otherwise as read_mesh_file and read_export do.
        """
        for path in export.files:
            if not path.is_file():
                raise IncompleteExportError(
                    "a file of the export is gone", where=str(path), remedy="Export the scan again and keep it"
                )
        if self._profile is not None:
            return read_export(self._profile, export, self._config.unit)
        return read_mesh_file(export.files[0], self._config.unit, export=export)

    def _expected(self) -> dict[str, str]:
        if self._profile is None:
            return {"unit": self._config.unit}
        units = ", ".join(f"{suffix[1:]} in {unit}" for suffix, unit in self._profile.units.items())
        return {"unit": self._config.unit, "profile": f"{self._config.profile}: {units}. {self._profile.advice}"}

    def _foreign(self) -> tuple[str, ...]:
        """One sentence for each file that some scanner exports, but not the one of the profile."""
        if self._profile is None:
            return ()
        others = tuple(suffix for suffix in _SURFACES if suffix not in self._profile.suffixes)
        known = ", ".join(suffix[1:].upper() for suffix in self._profile.suffixes)
        return tuple(
            f"{name_of(path)}: the profile {self._config.profile} does not read this kind of file, only {known}. "
            f"{self._profile.advice}"
            for path in mesh_files(self._config.folder, others)
        )

    def _identity(self) -> DeviceIdentity:
        return DeviceIdentity(
            kind="scanner",
            model="export folder" if self._profile is None else self._profile.scanner,
            serial="",
            firmware="",
            driver="scan_folder",
            driver_version=f"orthocapture {version('orthocapture')}",
            address=str(self._config.folder),
        )


def _modified_ns(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:  # it has gone meanwhile
        return 0


def require_folder(folder: Path) -> None:
    """Raise DeviceUnavailableError unless the folder exists."""
    if not folder.is_dir():
        raise DeviceUnavailableError(
            "there is no such folder",
            where=str(folder),
            remedy="Mount the share, or correct the folder in rig.yaml",
        )


def free_bytes(folder: Path) -> int | None:
    """Free space of the folder's file system in bytes; None if it does not report any."""
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return None


DRIVER = DriverSpec(kind="scanner", config=ScanFolderConfig, build=ScanFolder, hosted=False, call_timeout_s=300.0)
