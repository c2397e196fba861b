"""Driver for a CT suite, through the folder of DICOM series, segmentations and meshes that it delivers."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from drivers.interfaces import CtSource
from drivers.meshes.mesh_file import MeshUnit
from drivers.plugin import DriverConfig, DriverSpec


class DicomFolderConfig(DriverConfig):
    """The CT suite's section in rig.yaml."""

    folder: Path = Field(description="where the CT suite delivers its series, in sub-folders or not")
    mesh_unit: MeshUnit = Field(
        default="auto", description="unit of segmented meshes: mm, m, or auto (from the size)"
    )
    stable_s: float = Field(
        default=10.0, ge=0, description="how long a series or a segmented mesh must stay unchanged; 10 s on a share"
    )
    first_number: int = Field(
        default=1,
        ge=0,
        description="number of the first slice of a whole series (InstanceNumber); a series that begins later is "
        "incomplete",
    )
    unspecified_is_hounsfield: bool = Field(
        default=False,
        description="values whose unit the files state as unspecified are Hounsfield units (rescale type US, as some "
        "programs write it when they copy a series)",
    )
    series: str = Field(
        default="",
        description="part of the SeriesDescription of the series to use, such as MonoEnergeticPlus 70 keV, where the "
        "suite delivers several products of one acquisition; empty: any, and of several a person is asked",
    )
    deidentify: bool = Field(
        default=True,
        description="keep copies of series and segmentations that name no person, instead of the files themselves",
    )


def _folder(config: DicomFolderConfig) -> CtSource:
    from drivers.dicom_folder.folder import DicomFolder  # noqa: PLC0415 - pydicom: half a second, for those who open it

    return DicomFolder(config)


DRIVER = DriverSpec(kind="ct", config=DicomFolderConfig, build=_folder, hosted=False, call_timeout_s=300.0)
