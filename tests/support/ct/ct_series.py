"""A small CT series of known voxels, written with pydicom slice by slice."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.uid import UID, CTImageStorage, ExplicitVRLittleEndian, RLELossless, generate_uid

from drivers.interfaces import Array

Change = Callable[[Dataset, int], None]
SHAPE = (5, 6, 8)  # K, J, I
SPACING_MM = (0.4, 0.5, 0.6)  # i, j, k


def pixels() -> Array:
    """The stored values (K, J, I); Hounsfield units are twice these, less 1000."""
    return np.arange(np.prod(SHAPE)).reshape(SHAPE).astype(np.float64)


def write_series(
    folder: Path,
    *,
    rotation: Array | None = None,
    change: Change | None = None,
    skip: tuple[int, ...] = (),
    syntax: UID = ExplicitVRLittleEndian,
    uid: str | None = None,
    reverse: bool = False,
) -> Array:
    """Write a series of SHAPE; returns T_ct_voxel in metres."""
    folder.mkdir(parents=True, exist_ok=True)
    R = np.eye(3) if rotation is None else rotation
    origin = np.array([12.5, -40.25, 7.0])
    uid = uid or generate_uid()
    for k in range(SHAPE[0]):
        if k in skip:
            continue
        meta = FileMetaDataset()
        meta.TransferSyntaxUID = ExplicitVRLittleEndian if syntax == RLELossless else syntax
        meta.MediaStorageSOPClassUID = CTImageStorage
        meta.MediaStorageSOPInstanceUID = generate_uid()
        ds = FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
        ds.SOPClassUID, ds.SOPInstanceUID, ds.SeriesInstanceUID = CTImageStorage, meta.MediaStorageSOPInstanceUID, uid
        ds.FrameOfReferenceUID, ds.StudyInstanceUID = f"{uid[:60]}.1", f"{uid[:60]}.2"
        ds.Modality, ds.SeriesDescription, ds.InstanceNumber = "CT", "test", k + 1
        ds.ImageType = ["ORIGINAL", "PRIMARY", "AXIAL"]
        ds.Rows, ds.Columns, ds.SamplesPerPixel = SHAPE[1], SHAPE[2], 1
        ds.PhotometricInterpretation = "MONOCHROME2"
        ds.BitsAllocated, ds.BitsStored, ds.HighBit, ds.PixelRepresentation = 16, 16, 15, 0
        ds.PixelSpacing = [SPACING_MM[1], SPACING_MM[0]]
        ds.ImageOrientationPatient = [f"{x:.10f}"[:16] for x in [*R[:, 0], *R[:, 1]]]
        ds.ImagePositionPatient = [f"{x:.8f}"[:16] for x in origin + k * SPACING_MM[2] * R[:, 2]]
        ds.RescaleSlope, ds.RescaleIntercept = 2, -1000
        ds.PixelData = pixels()[k].astype("<u2").tobytes()
        ds["PixelData"].VR = "OW"
        if change is not None:
            change(ds, k)
        if syntax == RLELossless:
            ds.compress(RLELossless)
        order = SHAPE[0] - k if reverse else k
        ds.save_as(folder / f"I{order:04d}", enforce_file_format=True)
    T = np.eye(4)
    T[:3, :3] = R @ np.diag(SPACING_MM) * 1e-3
    T[:3, 3] = origin * 1e-3
    return T


def hospital(ds: Dataset, k: int) -> None:
    """What a hospital's scanner writes besides, and other programs ask for."""
    ds.PatientID, ds.PatientName, ds.PatientBirthDate, ds.PatientSex = "MRN-4711", "DOE^JOHN", "19500102", "M"
    ds.StudyID, ds.AccessionNumber, ds.ReferringPhysicianName = "77", "ACC-12", "HOUSE^G"
    ds.StudyDate = ds.SeriesDate = ds.AcquisitionDate = ds.ContentDate = "20260101"
    ds.StudyTime = ds.SeriesTime = ds.AcquisitionTime = ds.ContentTime = "120000"
    ds.InstitutionName, ds.StationName, ds.OperatorsName = "General Hospital", "CT-3", "SMITH^A"
    ds.Manufacturer, ds.DeviceSerialNumber, ds.SeriesNumber, ds.AcquisitionNumber = "M", "SN-99", 1, 1
    ds.SliceThickness, ds.KVP, ds.PatientPosition = SPACING_MM[2], 120, "HFS"


def enhanced_of(slices: Path, series_uid: str) -> Any:
    """The single slices of a folder as one multi-frame file by highdicom, to be saved with `save_as`."""
    from highdicom.legacy import LegacyConvertedEnhancedCTImage  # noqa: PLC0415 - every worker collects every file

    return LegacyConvertedEnhancedCTImage(
        legacy_datasets=[pydicom.dcmread(path) for path in sorted(slices.iterdir())],
        series_instance_uid=series_uid,
        series_number=2,
        sop_instance_uid=generate_uid(),
        instance_number=1,
        transfer_syntax_uid=ExplicitVRLittleEndian,
    )
