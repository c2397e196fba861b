"""The interfaces of a scanner and of a CT suite, and the meshes and volumes that they deliver."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces.device import Array, Device, Transform


@dataclass(frozen=True, slots=True)
class Mesh:
    """A triangle mesh in metres."""

    vertices_m: Array  # (V, 3)
    faces: NDArray[np.int32]  # (F, 3)
    normals: Array  # (V, 3), computed if the file had none


@dataclass(frozen=True, slots=True)
class ScanExport:
    """A complete export found in the scanner's folder: the mesh file first, then its companions."""

    name: str
    files: tuple[Path, ...]
    modified_utc: str


@dataclass(frozen=True, slots=True)
class ScannedMesh:
    """A mesh read from a scan export, with its unit and its findings."""

    mesh: Mesh
    unit: str  # of the file: mm, m, …
    unit_evidence: str  # how that unit was determined
    findings: Mapping[
        str, float
    ]  # holes, non_manifold_edges, components, degenerate_faces, polygons_in_doubt, normals_computed, textures
    source: ScanExport


class Scanner(Device, Protocol):
    """A hand scanner, accessed through the folder into which its software exports."""

    def exports(self) -> tuple[ScanExport, ...]:
        """Return the complete, stable exports, oldest first, without those that are still being written."""
        ...

    def read(self, export: ScanExport) -> ScannedMesh:
        """Read one export. Raises UnreadableFileError or IncompleteExportError with the reason."""
        ...


@dataclass(frozen=True, slots=True)
class CtSeries:
    """One series of a DICOM folder."""

    uid: str
    description: str
    modality: str
    slices: int
    files: tuple[Path, ...]
    problems: tuple[str, ...]  # localiser, gap, mixed orientation, …; a series with problems is not read
    frame_of_reference: str = ""  # its UID; "" if the series states none
    acquired_images: int | None = (
        None  # of its acquisition, as the files state: more than slices if it has other series
    )


@dataclass(frozen=True, slots=True)
class CtVolume:
    """A volume in Hounsfield units; p_ct = T_ct_voxel @ (i, j, k) with i along columns, k along slices, metres."""

    hounsfield: NDArray[np.int16]  # (K, J, I)
    T_ct_voxel: Transform  # (4, 4), affine: spacing and direction included
    spacing_m: tuple[float, float, float]  # i, j, k
    series: CtSeries


@dataclass(frozen=True, slots=True)
class CtLabels:
    """A segmentation on the voxels of a series."""

    inside: NDArray[np.bool_]  # (K, J, I)
    segments: tuple[str, ...]  # the names of those that it holds
    source: ScanExport


@dataclass(frozen=True, slots=True)
class CleanFile:
    """A copy of a file without what may name people."""

    path: Path
    original_sha256: str
    removed: tuple[str, ...]  # keywords of the attributes that were removed, never their values


class CtSource(Device, Protocol):
    """A CT suite, accessed through the DICOM folder that it delivers."""

    def series(self) -> tuple[CtSeries, ...]:
        """Return the series found, including those with problems, oldest first."""
        ...

    def read(self, series: CtSeries) -> CtVolume:
        """Read one series. Raises UnreadableFileError, which names the gap, the slice and the file."""
        ...

    def without_personal_data(self, source: Path, target: Path) -> CleanFile | None:
        """Copy a file of a series or segmentation without what may name people; None if the rig keeps files as is.

        Raises UnreadableFileError if that is not possible.
        """
        ...

    def segmentations(self) -> tuple[ScanExport, ...]:
        """Return the complete segmentations in the folder (DICOM SEG, NIfTI), oldest first."""
        ...

    def read_labels(self, segmentation: ScanExport, volume: CtVolume, segments: tuple[str, ...]) -> CtLabels:
        """Read the named segments, or all, of a segmentation of this volume.

        Raises UnreadableFileError if its voxels are not those of the volume, or a segment is missing.
        """
        ...

    def segmented_meshes(self) -> tuple[ScanExport, ...]:
        """Return the meshes in the folder that were segmented elsewhere (e.g. Mimics STL), oldest first."""
        ...

    def read_mesh(self, export: ScanExport) -> ScannedMesh:
        """Read one segmented mesh. Raises UnreadableFileError or IncompleteExportError with the reason."""
        ...
