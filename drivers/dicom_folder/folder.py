"""Reads the folder of DICOM series, segmentations and meshes that a CT suite delivers."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np

from drivers.dicom_folder import DicomFolderConfig
from drivers.dicom_folder.deidentify import deidentify
from drivers.dicom_folder.files import dicom_files
from drivers.dicom_folder.header_lines import header_lines
from drivers.dicom_folder.headers import SEGMENTATION, SliceHeader, read_headers
from drivers.dicom_folder.labels import voxels_inside
from drivers.dicom_folder.nifti import check_nifti, is_nifti, read_nifti
from drivers.dicom_folder.pixels import hounsfield
from drivers.dicom_folder.segmentation import read_segmentation
from drivers.dicom_folder.slices import acquired_images, arrange, problems_of
from drivers.errors import UnreadableFileError
from drivers.interfaces import (
    CleanFile,
    CtLabels,
    CtSeries,
    CtVolume,
    DeviceAnswers,
    DeviceIdentity,
    DeviceReport,
    ScanExport,
    ScannedMesh,
)
from drivers.interfaces.answers import answers_of_headers
from drivers.meshes.export_watch import ExportWatch
from drivers.meshes.mesh_file import read_mesh_file
from drivers.scan_folder import free_bytes, require_folder

_MOST_HEADERS = 50  # in a recording of devices
_ARRIVING = "still arriving"
_Headers = tuple[SliceHeader, ...] | str  # of one file; or why it cannot be read


_FileKey = tuple[Path, int, int]  # path, size, mtime in ns


@dataclass(frozen=True, slots=True)
class _Arrival:
    """The files of a series, since when this host has seen them unchanged, and when the newest was written."""

    files: frozenset[_FileKey]
    since_s: float
    newest_ns: int


class DicomFolder:
    """drivers.interfaces.CtSource on a folder, which it reads but never changes."""

    def __init__(self, config: DicomFolderConfig, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._config = config
        self._monotonic = monotonic
        self._watch = ExportWatch(config.folder, config.stable_s, monotonic)
        self._niftis = ExportWatch(
            config.folder, config.stable_s, monotonic, suffixes=(".nii", ".gz"), check=check_nifti
        )
        self._headers: dict[_FileKey, _Headers] = {}
        self._arrivals: dict[str, _Arrival] = {}

    def open(self) -> DeviceIdentity:
        """Check that the folder exists and start watching it; raises DeviceUnavailableError if it does not."""
        require_folder(self._config.folder)
        self._watch.poll()
        self._niftis.poll()
        self._groups()
        return self._identity()

    def close(self) -> None:
        """Do nothing: nothing is kept open."""

    def report(self) -> DeviceReport:
        """Return the number of series, their problems, and the files that are not DICOM."""
        series = self._all_series()
        arriving = [one for one in series if any(text.startswith(_ARRIVING) for text in one.problems)]
        # A series in transfer is not a fault, and its other problems may only be due to missing files.
        problems = [
            f"series {one.uid} ({one.description}): {text}"
            for one in series
            if one not in arriving
            for text in one.problems
        ]
        problems += [text for text in self._headers.values() if isinstance(text, str)]
        problems += self._without_the_wanted(series)
        meshes, volumes = self._watch.poll(), self._niftis.poll()
        usable = [str(one.slices) for one in series if not one.problems and self._is_wanted(one)]
        return DeviceReport(
            identity=self._identity(),
            free_bytes=free_bytes(self._config.folder),
            details={
                "series": str(len(series)),
                "usable": f"{len(usable)}, of {', '.join(usable)} slices" if usable else "0",
                "arriving": str(len(arriving) + meshes.arriving + volumes.arriving),
                **self._asked_for(series),
                "stable_s": f"{self._config.stable_s:g}",
            },
            problems=(*problems, *meshes.problems, *volumes.problems),
        )

    def answers(self) -> DeviceAnswers:
        """The header of one file of each series and each segmentation."""
        firsts = [headers[0].path for headers in self._groups().values()][-_MOST_HEADERS:]
        return answers_of_headers(map(header_lines, firsts))

    def series(self) -> tuple[CtSeries, ...]:
        """Return all series with images, including those with problems, oldest first.

        If rig.yaml says which product of an acquisition to use, only those of that description.

        A series that this driver saw change less than `stable_s` ago has the problem "still arriving", because a
        series in transfer looks like a complete, shorter one. The age of the files is not used, since copying may
        preserve it and the clock of a share may differ.
        """
        return tuple(one for one in self._all_series() if self._is_wanted(one))

    def read(self, series: CtSeries) -> CtVolume:
        """Read one series into Hounsfield units.

        Voxel axes: i along a row of the image, j down its columns, k along their cross product, so that T_ct_voxel is
        right-handed whatever the order of the files. The ct frame is DICOM's patient frame (x left, y back, z head),
        in metres.

        Raises:
            UnreadableFileError: the series has problems, or a slice cannot be decoded; names the slice and the file.
        """
        found = [self._header(path) for path in series.files]
        sound = [header for headers in found if not isinstance(headers, str) for header in headers]
        problems = [headers for headers in found if isinstance(headers, str)] + list(self._problems(sound))
        if problems:
            raise UnreadableFileError(
                f"the series cannot be used: {'; '.join(problems)}",
                where=f"{series.uid} in {self._config.folder}",
                remedy="Export the complete series again from the CT suite; gaps are never interpolated",
            )
        ordered, T_ct_voxel, spacing = arrange(sound)
        first = ordered[0]
        volume = np.empty((len(ordered), first.rows, first.columns), dtype=np.int16)
        for k, pixels in enumerate(hounsfield(ordered)):
            volume[k] = pixels
        return CtVolume(volume, T_ct_voxel, spacing, self._series(series.uid, ordered, ()))

    def without_personal_data(self, source: Path, target: Path) -> CleanFile | None:
        """Copy a file of a series or segmentation without what may name people; None if the rig keeps files as is.

        Raises UnreadableFileError as drivers.dicom_folder.deidentify.deidentify does.
        """
        return deidentify(source, target) if self._config.deidentify else None

    def segmentations(self) -> tuple[ScanExport, ...]:
        """Return the complete segmentations in the folder (DICOM SEG, NIfTI), oldest first."""
        groups = self._groups()
        found = list(self._niftis.poll().complete)
        for uid, headers in groups.items():
            if headers[0].modality == SEGMENTATION and not self._arriving(uid):
                found += [_segmentation(path) for path in dict.fromkeys(header.path for header in headers)]
        return tuple(sorted(found, key=lambda export: (export.modified_utc, export.name)))

    def read_labels(self, segmentation: ScanExport, volume: CtVolume, segments: tuple[str, ...]) -> CtLabels:
        """Read the named segments, or all, of a segmentation of this volume.

        Raises:
            IncompleteExportError: a NIfTI file is cut short.
            UnreadableFileError: the file is damaged, a segment is missing, or its voxels are not those of the volume.
        """
        path, shape = segmentation.files[0], volume.hounsfield.shape
        if is_nifti(path):
            block, names = read_nifti(path, segments, most_voxels=volume.hounsfield.size)
            blocks = [block]
        else:
            blocks, names = read_segmentation(path, segments, volume.series.frame_of_reference)
        inside = voxels_inside(blocks, (shape[0], shape[1], shape[2]), volume.T_ct_voxel, path)
        if not inside.any():
            raise UnreadableFileError(
                f"the segments {', '.join(names)} are empty",
                where=str(path),
                remedy="Name other segments in the step, or segment the series again",
            )
        return CtLabels(inside, names, segmentation)

    def segmented_meshes(self) -> tuple[ScanExport, ...]:
        """Return the complete segmented meshes in the folder (STL, PLY, OBJ), oldest first."""
        require_folder(self._config.folder)
        return self._watch.poll().complete

    def read_mesh(self, export: ScanExport) -> ScannedMesh:
        """Read one segmented mesh, in metres; raises as drivers.meshes.mesh_file.read_mesh_file does."""
        return read_mesh_file(export.files[0], self._config.mesh_unit, export=export)

    def _all_series(self) -> tuple[CtSeries, ...]:
        found = [
            self._series(uid, headers, self._arriving(uid))
            for uid, headers in self._groups().items()
            if headers[0].modality != SEGMENTATION
        ]
        return tuple(sorted(found, key=lambda one: (self._arrivals[one.uid].newest_ns, one.uid)))

    def _is_wanted(self, series: CtSeries) -> bool:
        return self._config.series.casefold() in series.description.casefold()

    def _asked_for(self, series: Sequence[CtSeries]) -> dict[str, str]:
        if not self._config.series:
            return {}
        others = [one.description or one.uid for one in series if not self._is_wanted(one)]
        return {"series to use": self._config.series, "not used": ", ".join(others) or "none"}

    def _without_the_wanted(self, series: Sequence[CtSeries]) -> list[str]:
        if not series or any(self._is_wanted(one) for one in series):
            return []
        there = ", ".join(repr(one.description) for one in series)
        return [f"no series has a description with {self._config.series!r}, as rig.yaml wants; there are {there}"]

    def _groups(self) -> dict[str, list[SliceHeader]]:
        """The readable slices by the UID of their series, and since when each series has not changed."""
        require_folder(self._config.folder)
        groups: dict[str, list[SliceHeader]] = {}
        keys: dict[str, set[_FileKey]] = {}
        unread: set[_FileKey] = set()  # each may be the beginning of another slice, of any series
        for key, headers in self._scan().items():
            if isinstance(headers, str):
                unread.add(key)
                continue
            for header in headers:
                groups.setdefault(header.series_uid, []).append(header)
                keys.setdefault(header.series_uid, set()).add(key)
        now = self._monotonic()
        arrivals: dict[str, _Arrival] = {}
        for uid, own in keys.items():
            files, old = frozenset(own | unread), self._arrivals.get(uid)
            newest_ns = max(modified_ns for _, _, modified_ns in own)
            arrivals[uid] = old if old is not None and old.files == files else _Arrival(files, now, newest_ns)
        self._arrivals = arrivals
        return groups

    def _scan(self) -> dict[_FileKey, _Headers]:
        fresh: dict[_FileKey, _Headers] = {}
        for path in dicom_files(self._config.folder):
            try:
                key = _key(path)
            except FileNotFoundError:  # renamed since the folder was listed, as at the end of a transfer
                continue
            fresh[key] = self._header(path)
        self._headers = fresh
        return fresh

    def _arriving(self, uid: str) -> tuple[str, ...]:
        waited_s = self._monotonic() - self._arrivals[uid].since_s
        if waited_s >= self._config.stable_s:
            return ()
        return (f"{_ARRIVING}: unchanged for {waited_s:.1f} s, waiting for {self._config.stable_s:g} s",)

    def _header(self, path: Path) -> _Headers:
        """The headers, or why they cannot be read; a file that does not change is read only once."""
        try:
            known = self._headers.get(_key(path))
        except OSError as error:
            return f"{path.name}: cannot be opened ({error.strerror})"
        return read_headers(path) if known is None else known

    def _problems(self, headers: Sequence[SliceHeader]) -> tuple[str, ...]:
        return problems_of(
            headers,
            self._config.first_number,
            unspecified_is_hounsfield=self._config.unspecified_is_hounsfield,
        )

    def _series(self, uid: str, headers: list[SliceHeader], arriving: tuple[str, ...]) -> CtSeries:
        return CtSeries(
            uid=uid,
            description=headers[0].description,
            modality=headers[0].modality,
            slices=len(headers),
            files=tuple(dict.fromkeys(header.path for header in headers)),
            problems=arriving + self._problems(headers),
            frame_of_reference=headers[0].frame_of_reference,
            acquired_images=acquired_images(headers),
        )

    def _identity(self) -> DeviceIdentity:
        return DeviceIdentity(
            kind="ct",
            model="DICOM folder",
            serial="",
            firmware="",
            driver="dicom_folder",
            driver_version=f"pydicom {version('pydicom')}",
            address=str(self._config.folder),
        )


def _key(path: Path) -> _FileKey:
    stat = path.stat()
    return path, stat.st_size, stat.st_mtime_ns


def _segmentation(path: Path) -> ScanExport:
    modified = datetime.fromtimestamp(path.stat().st_mtime, UTC).isoformat().replace("+00:00", "Z")
    return ScanExport(path.name, (path,), modified)
