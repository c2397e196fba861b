"""Fuzz targets for what other programs exchange: segmentations of a CT, received DICOM files, recordings of ROS 2."""

from __future__ import annotations

import gzip
import io
from pathlib import Path

import numpy as np

from drivers.dicom_folder import DicomFolderConfig
from drivers.dicom_folder.deidentify import deidentify
from drivers.dicom_folder.folder import DicomFolder
from drivers.dicom_receiver.staging import Staging
from service.compute.camera_model import CameraModel
from service.compute.poses.ros_messages import (
    DEFINITIONS,
    StampedImage,
    StampedTransform,
    encode_camera_info,
    encode_image,
    encode_pose,
    encode_tf,
)
from service.compute.poses.ros_recording import read_recording
from tests.support.torture.fuzz.mutations import BYTES, TEXT
from tests.support.torture.fuzz.targets.files.delivered import ROWS, SLICES, write_slices
from tests.support.torture.fuzz.targets.target import MisbehavedError, Target

_NIFTI_BYTES = 352


# --- segmentations ------------------------------------------------------------------------------------------------


def _nifti() -> bytes:
    """A NIfTI-1 label image on the voxels of `write_slices`."""
    head = np.zeros(_NIFTI_BYTES, dtype=np.uint8)
    head[:4] = np.frombuffer(np.int32(348).tobytes(), np.uint8)
    head[40:56] = np.frombuffer(np.array([3, ROWS, ROWS, SLICES, 1, 1, 1, 1], "<i2").tobytes(), np.uint8)
    head[70:74] = np.frombuffer(np.array([2, 8], "<i2").tobytes(), np.uint8)
    head[76:108] = np.frombuffer(np.ones(8, "<f4").tobytes(), np.uint8)
    head[108:112] = np.frombuffer(np.float32(_NIFTI_BYTES).tobytes(), np.uint8)
    head[123] = 2
    head[254:256] = np.frombuffer(np.int16(1).tobytes(), np.uint8)
    head[280:328] = np.frombuffer(np.diag([-1.0, -1.0, 1.0, 0.0])[:3].astype("<f4").tobytes(), np.uint8)
    head[344:348] = np.frombuffer(b"n+1\0", np.uint8)
    labels = np.random.default_rng(4).integers(0, 3, ROWS * ROWS * SLICES).astype(np.uint8)
    return head.tobytes() + labels.tobytes()


def _niftis(_: Path) -> list[bytes]:
    return [_nifti(), gzip.compress(_nifti(), mtime=0)]


def _segmentations(folder: Path) -> list[bytes]:
    """A binary DICOM SEG of the first slice of `write_slices`."""
    import pydicom  # noqa: PLC0415 - only the seed needs it
    from pydicom.uid import UID  # noqa: PLC0415

    write_slices(folder)
    first = pydicom.dcmread(min(folder.glob("*.dcm")))
    item = pydicom.Dataset
    measures, orientation, position, number, segment, frame, shared = (item() for _ in range(7))
    measures.PixelSpacing = first.PixelSpacing
    orientation.ImageOrientationPatient = first.ImageOrientationPatient
    position.ImagePositionPatient = first.ImagePositionPatient
    number.ReferencedSegmentNumber = segment.SegmentNumber = 1
    segment.SegmentLabel = "bone"
    frame.PlanePositionSequence, frame.SegmentIdentificationSequence = [position], [number]
    shared.PixelMeasuresSequence, shared.PlaneOrientationSequence = [measures], [orientation]
    first.SOPClassUID = first.file_meta.MediaStorageSOPClassUID = UID("1.2.840.10008.5.1.4.1.1.66.4")
    first.SOPInstanceUID = first.file_meta.MediaStorageSOPInstanceUID = UID("1.2.3.9")
    first.SeriesInstanceUID, first.Modality, first.SegmentationType = "1.2.3.8", "SEG", "BINARY"
    first.NumberOfFrames, first.BitsAllocated, first.BitsStored, first.HighBit = 1, 1, 1, 0
    first.SegmentSequence, first.PerFrameFunctionalGroupsSequence = [segment], [frame]
    first.SharedFunctionalGroupsSequence = [shared]
    first.PixelData = np.packbits(np.resize([1, 0, 1], ROWS * ROWS), bitorder="little").tobytes().ljust(6, b"\0")
    out = io.BytesIO()
    first.save_as(out, enforce_file_format=True)
    return [out.getvalue()]


def _labels(name: str, data: bytes, folder: Path) -> None:
    """Read the labels of a series, of which the file is the input, and copy it without personal data."""
    write_slices(folder)
    path = folder / name
    path.write_bytes(data)
    source = DicomFolder(DicomFolderConfig(folder=folder, stable_s=0))
    source.open()
    source.report()
    (series,) = [one for one in source.series() if one.uid == "1.2.3.4"]
    volume = source.read(series)
    for found in source.segmentations():
        if not source.read_labels(found, volume, ()).inside.any():
            raise MisbehavedError("empty labels are accepted")
    deidentify(path, folder / f"clean_{name}")


def _nifti_labels(data: bytes, folder: Path) -> None:
    _labels("labels.nii.gz" if data.startswith(b"\x1f\x8b") else "labels.nii", data, folder)


# --- received and copied DICOM ------------------------------------------------------------------------------------


def _slices(folder: Path) -> list[bytes]:
    write_slices(folder)
    return [path.read_bytes() for path in sorted(folder.glob("*.dcm"))][:1]


def _clean(data: bytes, folder: Path) -> None:
    source = folder / "slice.dcm"
    source.write_bytes(data)
    deidentify(source, folder / "clean.dcm")
    if b"SPECIMEN^SIMULATED" in (folder / "clean.dcm").read_bytes():
        raise MisbehavedError("a person's name is left in the copy")


def _uids(_: Path) -> list[bytes]:
    return [b"1.2.3.4 1.2.3.4.5"]


def _stored(data: bytes, folder: Path) -> None:
    """A file with these UIDs of series and instance arrives."""
    series, _, instance = data.decode("latin-1").partition(" ")
    staging = Staging(folder / "ct", 0)
    staging.store("a sender", series, instance, b"data")
    staging.ended("a sender", released=True)
    if {path.name for path in folder.iterdir()} != {"ct"} or not (
        folder / "ct" / series / f"{instance}.dcm"
    ).is_file():
        raise MisbehavedError("a file lies elsewhere")


# --- recordings of ROS 2 ------------------------------------------------------------------------------------------


def _recordings(_: Path) -> list[bytes]:
    from mcap.writer import CompressionType, Writer  # noqa: PLC0415 - only the seed needs it

    found: list[bytes] = []
    T = np.eye(4)
    for compression in (CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4):
        out = io.BytesIO()
        writer = Writer(out, compression=compression)
        writer.start(profile="ros2")
        messages = {
            "/tf": ("tf2_msgs/msg/TFMessage", encode_tf([StampedTransform(5, "base", "flange", T)])),
            "/pose": ("geometry_msgs/msg/PoseWithCovarianceStamped", encode_pose(5, "base", T, np.eye(6))),
            "/info": ("sensor_msgs/msg/CameraInfo", encode_camera_info(5, "camera", CameraModel(8, 6, 9, 9, 4, 3))),
            "/image": ("sensor_msgs/msg/CompressedImage", encode_image(StampedImage(5, "camera", "jpeg", b"abc"))),
        }
        for topic, (kind, data) in messages.items():
            schema = writer.register_schema(kind, "ros2msg", DEFINITIONS[kind].encode())
            writer.add_message(writer.register_channel(topic, "cdr", schema), 5, data, 5)
        writer.finish()
        found.append(out.getvalue())
    return found


def _recording(data: bytes, folder: Path) -> None:
    path = folder / "recording.mcap"
    path.write_bytes(data)
    found = read_recording(path)
    for poses in found.poses.values():
        if not all(np.isfinite(one.T_parent_child).all() for one in poses):
            raise MisbehavedError("a pose that is not finite is accepted")


TARGETS: tuple[Target, ...] = (
    Target("nifti_labels", "drivers.dicom_folder.nifti:read_nifti", _nifti_labels, _niftis, pace=0.5),
    Target(
        "dicom_seg",
        "drivers.dicom_folder.segmentation:read_segmentation",
        lambda data, folder: _labels("seg.dcm", data, folder),
        _segmentations,
        (*BYTES, *TEXT),
        pace=0.5,
    ),
    Target("deidentify", "drivers.dicom_folder.deidentify:deidentify", _clean, _slices, (*BYTES, *TEXT)),
    Target("received_uids", "drivers.dicom_receiver.staging:Staging", _stored, _uids, (*BYTES, *TEXT)),
    Target("ros_recording", "service.compute.poses.ros_recording:read_recording", _recording, _recordings),
)
