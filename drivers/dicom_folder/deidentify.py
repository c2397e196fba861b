"""Makes copies of DICOM files that name no person: only what the images need stays, the pixels are not touched."""

from __future__ import annotations

import hashlib
import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import pydicom
from pydicom.dataelem import DataElement
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.uid import UID, ExplicitVRBigEndian, ExplicitVRLittleEndian, ImplicitVRLittleEndian

from drivers.dicom_folder.files import PARSE_ERRORS, read_dicom
from drivers.dicom_folder.nifti import is_nifti, without_texts
from drivers.errors import UnreadableFileError
from drivers.interfaces import CleanFile

# Two values, because DICOM allows 64 characters for each (PS3.5, value representation LO).
_METHOD = ("orthocapture: all attributes removed but those of the images", "UIDs replaced")
# What stays, here and in nested items: modality, geometry, pixels, acquisition, segments. Everything else goes,
# private attributes too: a list of what is known to be harmless is safer than one of what is known to name people.
_KEPT = frozenset(
    re.findall(
        r"\w+",
        """
    SpecificCharacterSet ImageType SOPClassUID SOPInstanceUID Modality ConversionType Manufacturer
    ManufacturerModelName SoftwareVersions StudyInstanceUID SeriesInstanceUID SeriesNumber AcquisitionNumber
    InstanceNumber FrameOfReferenceUID PositionReferenceIndicator ImagePositionPatient ImageOrientationPatient
    SliceLocation PatientPosition BodyPartExamined SamplesPerPixel PhotometricInterpretation Rows Columns
    PixelSpacing PixelAspectRatio BitsAllocated BitsStored HighBit PixelRepresentation SmallestImagePixelValue
    LargestImagePixelValue PixelPaddingValue PixelPaddingRangeLimit WindowCenter WindowWidth RescaleIntercept
    RescaleSlope RescaleType PixelData PlanarConfiguration LossyImageCompression LossyImageCompressionRatio
    LossyImageCompressionMethod BurnedInAnnotation ScanOptions SliceThickness SpacingBetweenSlices KVP
    DataCollectionDiameter ReconstructionDiameter DistanceSourceToDetector DistanceSourceToPatient
    GantryDetectorTilt TableHeight RotationDirection ExposureTime XRayTubeCurrent Exposure FilterType
    GeneratorPower FocalSpots ConvolutionKernel RevolutionTime SingleCollimationWidth TotalCollimationWidth
    TableSpeed TableFeedPerRotation SpiralPitchFactor CTDIvol NumberOfFrames SharedFunctionalGroupsSequence
    PerFrameFunctionalGroupsSequence PixelMeasuresSequence PlaneOrientationSequence PlanePositionSequence
    PixelValueTransformationSequence CTImageFrameTypeSequence FrameType FrameContentSequence
    FrameAcquisitionNumber StackID InStackPositionNumber DimensionIndexValues TemporalPositionIndex
    DimensionOrganizationSequence DimensionOrganizationUID DimensionOrganizationType DimensionIndexSequence
    DimensionIndexPointer FunctionalGroupPointer FrameVOILUTSequence VolumetricProperties
    VolumeBasedCalculationTechnique PixelPresentation PresentationLUTShape ContentQualification
    SegmentationType SegmentationFractionalType MaximumFractionalValue SegmentSequence SegmentNumber
    SegmentLabel SegmentAlgorithmType SegmentIdentificationSequence ReferencedSegmentNumber
    SegmentedPropertyCategoryCodeSequence SegmentedPropertyTypeCodeSequence CodeValue CodingSchemeDesignator
    CodeMeaning SegmentsOverlap ReferencedSeriesSequence ReferencedInstanceSequence ReferencedSOPClassUID
    ReferencedSOPInstanceUID DerivationImageSequence SourceImageSequence ImagesInAcquisition ConcatenationUID
    InConcatenationNumber InConcatenationTotalNumber ConcatenationFrameOffsetNumber
    """,
    )
)
# Attributes that a CT image must have; they stay empty (DICOM PS3.3, type 2).
_EMPTY = (
    "StudyDate", "StudyTime", "AccessionNumber", "ReferringPhysicianName", "PatientName", "PatientID",
    "PatientBirthDate", "PatientSex", "StudyID",
)  # fmt: skip
_UNCHANGED_UIDS = ("SOPClassUID", "ReferencedSOPClassUID")  # of kinds of objects, not of objects
_META_KEPT = ("MediaStorageSOPClassUID", "TransferSyntaxUID")


def deidentify(source: Path, target: Path) -> CleanFile:
    """Copy a DICOM or NIfTI file without what may name people.

    A UID of an instance, series, study or frame of reference is replaced by one that is computed from it
    (`2.25.` and 128 bits of its SHA-256), so that files that refer to each other still do, also between runs.

    Args:
        source: the file, which is not changed.
        target: a new file.

    Raises:
        UnreadableFileError: the file cannot be read, or states that text is burned into its pixels.
    """
    removed: set[str] = set()
    try:
        if is_nifti(source):
            removed.update(without_texts(source, target))
        else:
            _write_clean(source, target, removed)
        with source.open("rb") as file:
            original = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise _refused(source, f"it cannot be copied ({error.strerror or error})") from error
    except PARSE_ERRORS as error:
        raise _refused(source, f"it cannot be read without its personal data ({error})") from error
    return CleanFile(target, original, tuple(sorted(removed)))


def _write_clean(source: Path, target: Path, removed: set[str]) -> None:
    dataset = read_dicom(source)
    if str(dataset.get("BurnedInAnnotation") or "").upper() == "YES":
        raise _refused(source, "it states that text is burned into its pixels, which may name a person")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        clean = FileDataset(str(target), copy_kept(dataset, removed), file_meta=_meta(dataset), preamble=b"\0" * 128)
        for name in _EMPTY:
            setattr(clean, name, "")
        clean.PatientIdentityRemoved = "YES"
        clean.DeidentificationMethod = list(_METHOD)
        pydicom.dcmwrite(target, clean, enforce_file_format=True)


def copy_kept(dataset: Dataset, removed: set[str], within: str = "") -> Dataset:
    """Copy the kept attributes, with UIDs replaced; the names of the others are added to `removed`."""
    clean = Dataset()
    for element in _elements(dataset):
        name = element.keyword
        if name not in _KEPT:
            if not (name in _EMPTY and element.is_empty):
                removed.add(within + _named(element))
        elif element.VR == "SQ":
            inside = [copy_kept(item, removed, f"{within}{name}/") for item in element.value]
            clean.add(DataElement(element.tag, "SQ", inside))
        elif element.VR == "UI" and name not in _UNCHANGED_UIDS:
            clean.add(DataElement(element.tag, "UI", _replaced(element.value)))
        else:
            clean.add(element)
    return clean


def _elements(dataset: Dataset) -> Iterator[DataElement]:
    for tag in list(dataset.keys()):
        yield dataset[tag]


def _named(element: DataElement) -> str:
    """The keyword of an attribute; its number if it has none, as private ones."""
    tag = element.tag
    kind = "private " if tag.is_private else ""
    return element.keyword or f"{kind}({tag.group:04X},{tag.element:04X})"


def _replaced(value: object) -> object:
    if isinstance(value, str):
        return new_uid(value) if value else ""
    return [new_uid(str(one)) for one in value] if isinstance(value, list | tuple) else value


def new_uid(uid: str) -> UID:
    """The UID that replaces another one; the same UID is always replaced by the same one."""
    return UID(f"2.25.{int.from_bytes(hashlib.sha256(uid.encode()).digest()[:16], 'big')}")


def _meta(dataset: FileDataset) -> FileMetaDataset:
    meta = FileMetaDataset()
    for element in getattr(dataset, "file_meta", ()):
        if element.keyword in _META_KEPT:
            meta.add(element)
    if "TransferSyntaxUID" not in meta:  # a file without this header, as some programs write them
        implicit, little = dataset.original_encoding
        explicit = ExplicitVRLittleEndian if little else ExplicitVRBigEndian
        meta.TransferSyntaxUID = ImplicitVRLittleEndian if implicit else explicit
    uid = str(dataset.get("SOPInstanceUID") or "")
    if uid:
        meta.MediaStorageSOPInstanceUID = new_uid(uid)
    return meta


def _refused(path: Path, why: str) -> UnreadableFileError:
    return UnreadableFileError(
        why,
        where=str(path),
        remedy="Export the series again without annotations and damaged files, or set `deidentify: false` for this "
        "device in rig.yaml if the files may be kept as they are",
    )
