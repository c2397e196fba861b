"""Segmentations of a CT series as other programs write them: DICOM SEG by highdicom, NIfTI labels by nibabel."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pydicom
from numpy.typing import NDArray
from pydicom.sr.codedict import codes
from pydicom.uid import generate_uid

from drivers.interfaces import Array
from tests.support.ct.ct_series import SHAPE

LPS_FROM_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
LABELS: NDArray[np.uint8] = np.random.default_rng(8).integers(0, 3, SHAPE).astype(np.uint8)  # K, J, I
LABELS[2] = 0  # highdicom leaves empty slices out


def write_seg(folder: Path, kind: str = "BINARY", **changed: Any) -> Path:
    """A segmentation of the series in `folder` with the segments bone (1) and spheres (2)."""
    from highdicom import AlgorithmIdentificationSequence  # noqa: PLC0415 - every worker collects every file
    from highdicom.seg import Segmentation, SegmentDescription  # noqa: PLC0415

    sources = sorted((pydicom.dcmread(path) for path in folder.iterdir()), key=lambda ds: int(ds.InstanceNumber))
    program = AlgorithmIdentificationSequence("test", codes.DCM.ArtificialIntelligence, "1")
    segments = [
        SegmentDescription(
            n,
            name,
            codes.SCT.AnatomicalStructure,
            codes.SCT.Bone,
            "SEMIAUTOMATIC",
            algorithm_identification=program,
        )
        for n, name in ((1, "bone"), (2, "spheres"))
    ]
    arguments: dict[str, Any] = {
        "source_images": sources,
        "pixel_array": LABELS,
        "segmentation_type": kind,
        "segment_descriptions": segments,
        "series_instance_uid": generate_uid(),
        "series_number": 9,
        "sop_instance_uid": generate_uid(),
        "instance_number": 1,
        "manufacturer": "M",
        "manufacturer_model_name": "N",
        "software_versions": "1",
        "device_serial_number": "2",
    }
    path = folder / "segmentation.dcm"
    Segmentation(**{**arguments, **changed}).save_as(path)
    return path


def write_nifti(path: Path, T_ct_voxel: Array, ijk: NDArray[Any], **texts: str) -> None:
    """Write labels (I, J, K), whose indices T_ct_voxel maps to DICOM's axes in metres."""
    affine = LPS_FROM_RAS @ T_ct_voxel
    affine[:3] *= 1e3
    image = nibabel.Nifti1Image(ijk, affine)
    image.header.set_xyzt_units("mm")
    for name, text in texts.items():
        image.header[name] = text
    nibabel.save(image, path)
