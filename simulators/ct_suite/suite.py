"""A simulated CT suite: scans the scene and writes or sends a DICOM series, in a patient frame of its own."""

from __future__ import annotations

import argparse
import logging
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.uid import UID, CTImageStorage, ExplicitVRLittleEndian, ImplicitVRLittleEndian, generate_uid

from simulators.ct_suite.sending import network_address, send_series
from simulators.ct_suite.volume import Grid, grid_around, voxelise
from simulators.faults import FaultPlan
from simulators.geometry import Array, from_euler, inverse
from simulators.scene.world import Scene, parse_moved
from simulators.serve import Request, SimulatorError, Termination, announce, told
from simulators.units import metres, mm

log = logging.getLogger(__name__)

RESCALE_INTERCEPT = -1024


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--scene", type=int, required=True, metavar="SEED", help="seed of the scene")
    parser.add_argument(
        "--moved",
        type=parse_moved,
        default=(),
        metavar="JSON",
        help="registration spheres moved, as a JSON list of lists: index, x, y, z",
    )
    parser.add_argument("--folder", type=Path, required=True, help="where the series is delivered")
    parser.add_argument("--once", action="store_true", help="end after one series")
    parser.add_argument(
        "--when-told", action="store_true", help="compute the first export, and write it when a line comes on stdin"
    )
    parser.add_argument("--voxel-mm", type=float, default=0.4, help="edge of the cubic voxels")
    parser.add_argument(
        "--control-spheres",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="the control spheres are in place",
    )
    parser.add_argument(
        "--send-to",
        type=network_address,
        metavar="HOST:PORT",
        help="send the series there (C-STORE, by dcmtk) instead",
    )
    parser.add_argument("--implicit-vr", action="store_true", help="write implicit VR little endian")


def serve(args: argparse.Namespace) -> None:
    """Write a series and print the ready line.

    Without --once serve until SIGTERM, with another series at each SIGUSR1. With --once SIGTERM ends it at once.
    """
    if args.voxel_mm <= 0:
        raise SimulatorError("--voxel-mm must be positive")
    args.folder.mkdir(parents=True, exist_ok=True)
    scene = Scene.generate(args.scene, args.moved)
    if args.once:
        _scan(scene, args, announce_it=True)
        return
    termination, another = Termination(), Request()
    _scan(scene, args, announce_it=True)
    another.serve(termination, lambda: _scan(scene, args, announce_it=False))


def true_frames(seed: int) -> tuple[Array, Array]:
    """Return T_world_ct (patient frame) and T_world_gantry (axes of the image grid), both (4, 4)."""
    rng = np.random.default_rng([seed, 0xC7])
    # The board lies slightly askew in the gantry, and the scanner defines the patient frame.
    T_world_gantry = from_euler(rng.uniform(-0.10, 0.10, 3) * [1.0, 1.0, 3.0], np.zeros(3))
    T_ct_gantry = from_euler(rng.uniform(-np.pi, np.pi, 3), rng.uniform(-0.3, 0.3, 3))
    return T_world_gantry @ inverse(T_ct_gantry), T_world_gantry


def _scan(scene: Scene, args: argparse.Namespace, *, announce_it: bool) -> None:
    T_world_ct, T_world_gantry = true_frames(scene.seed)
    grid = grid_around(scene, T_world_gantry, metres(args.voxel_mm), control_spheres=args.control_spheres)
    volume = voxelise(scene, grid, control_spheres=args.control_spheres)
    if announce_it and args.when_told and not told():
        return
    folder: Path = args.folder
    series = generate_uid(entropy_srcs=[str(scene.seed), str(args.voxel_mm), str(time.time_ns())])
    T_ct_grid = inverse(T_world_ct) @ grid.T_world_grid
    with tempfile.TemporaryDirectory(prefix="orthocapture-ct-") as own:
        target = Path(own)
        if args.send_to is None:
            number = 1 + len([entry for entry in folder.glob("series_*") if entry.is_dir()])
            target = folder / f"series_{number:02d}"
            target.mkdir()
        write_series(target, volume, grid, T_ct_grid, series, implicit=args.implicit_vr, faults=args.faults)
        if args.send_to is not None:
            send_series(target, *args.send_to)
    if announce_it:
        announce(
            folder=str(folder),
            series=str(series),
            slices=len(volume),
            truth={"T_world_ct": T_world_ct.tolist()},
        )


def write_series(
    folder: Path,
    volume: NDArray[np.int16],
    grid: Grid,
    T_ct_grid: Array,
    series: str,
    *,
    implicit: bool = False,
    faults: FaultPlan,
) -> None:
    """Write volume (K, J, I) as one DICOM file per slice.

    `T_ct_grid` is rigid, with its origin at the centre of voxel (0, 0, 0). Faults of the device `ct`: on `slice` drop
    (a gap), truncate, corrupt, duplicate, tilt, disk_full; on `series` localiser.
    """
    common = _common(volume.shape, grid, T_ct_grid, series)
    syntax = ImplicitVRLittleEndian if implicit else ExplicitVRLittleEndian
    number = 0
    for k in range(len(volume)):
        fault = faults.check("ct", "slice")
        kind = fault.kind if fault else ""
        if kind == "drop":
            number += 1
            continue
        if kind == "disk_full":
            raise SimulatorError(f"no space left in {folder}: the series is incomplete")
        position = mm(T_ct_grid[:3, 3] + k * grid.voxel_m * T_ct_grid[:3, 2])
        path = folder
        for _ in range(2 if kind == "duplicate" else 1):
            number += 1
            path = folder / f"CT{number:05d}.dcm"
            _write_slice(path, common, volume[k], position, number, syntax, tilted=kind == "tilt")
        if kind in ("truncate", "corrupt"):
            data = path.read_bytes()
            path.write_bytes(data[: len(data) // 2] if kind == "truncate" else b"\0" * 200 + data[200:])
    if (fault := faults.check("ct", "series")) is not None and fault.kind == "localiser":
        number += 1
        common.ImageType = ["ORIGINAL", "PRIMARY", "LOCALIZER"]
        position = mm(T_ct_grid[:3, 3])
        _write_slice(folder / f"CT{number:05d}.dcm", common, volume[0], position, number, syntax, tilted=True)


def _common(shape: tuple[int, ...], grid: Grid, T_ct_grid: Array, series: str) -> Dataset:
    """The elements that all slices share."""
    common = Dataset()
    common.ImageType = ["ORIGINAL", "PRIMARY", "AXIAL"]
    common.SOPClassUID = CTImageStorage
    common.Modality = "CT"
    common.Manufacturer = "orthocapture simulator"
    common.ManufacturerModelName = "simulated CT suite"
    common.PatientName = "SPECIMEN^SIMULATED"
    common.PatientID = "SIM"
    common.StudyInstanceUID = generate_uid(entropy_srcs=[series, "study"])
    common.SeriesInstanceUID = series
    common.FrameOfReferenceUID = generate_uid(entropy_srcs=[series, "frame"])
    common.SeriesDescription = f"specimen {mm(grid.voxel_m):.2f} mm"
    common.SeriesNumber, common.AcquisitionNumber, common.ImagesInAcquisition = 2, 1, shape[0]
    common.Rows, common.Columns = shape[1], shape[2]
    common.PixelSpacing = [_decimal(mm(grid.voxel_m))] * 2
    common.SliceThickness = _decimal(mm(grid.voxel_m))
    common.ImageOrientationPatient = [_decimal(x) for x in [*T_ct_grid[:3, 0], *T_ct_grid[:3, 1]]]
    common.SamplesPerPixel = 1
    common.PhotometricInterpretation = "MONOCHROME2"
    common.BitsAllocated = common.BitsStored = 16
    common.HighBit = 15
    common.PixelRepresentation = 0
    common.RescaleIntercept, common.RescaleSlope = RESCALE_INTERCEPT, 1
    common.RescaleType = "HU"
    common.KVP = 120
    return common


def _decimal(value: float) -> str:
    """Format a number as a DICOM decimal string, of at most 16 characters."""
    return f"{value:.10f}"[:16]


def _write_slice(
    path: Path,
    common: Dataset,
    hounsfield: NDArray[np.int16],
    position_mm: Array,
    number: int,
    syntax: UID,
    *,
    tilted: bool,
) -> None:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = CTImageStorage
    meta.MediaStorageSOPInstanceUID = generate_uid(entropy_srcs=[common.SeriesInstanceUID, str(number)])
    meta.TransferSyntaxUID = syntax
    image = FileDataset(str(path), {}, file_meta=meta, preamble=b"\0" * 128)
    image.update(common)
    image.SOPInstanceUID = meta.MediaStorageSOPInstanceUID
    image.InstanceNumber = number
    image.ImagePositionPatient = [_decimal(x) for x in position_mm]
    if tilted:
        row, column = np.array(common.ImageOrientationPatient, dtype=np.float64).reshape(2, 3)
        image.ImageOrientationPatient = [_decimal(x) for x in [*row, *np.cross(row, column)]]
    image.PixelData = (hounsfield - np.int16(RESCALE_INTERCEPT)).astype("<u2").tobytes()
    image["PixelData"].VR = "OW"
    image.save_as(path, enforce_file_format=True)
