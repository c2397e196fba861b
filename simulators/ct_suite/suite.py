"""A simulated CT suite: scans the scene and writes or sends a DICOM series, in a patient frame of its own."""

from __future__ import annotations

import argparse
import logging
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
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
from simulators.serve import Request, SimulatorError, Termination, announce, wait_for_line
from simulators.units import metres, mm

log = logging.getLogger(__name__)

RESCALE_INTERCEPT = -1024


@dataclass(frozen=True, slots=True)
class Product:
    """Holds what a photon-counting suite computes from an acquisition, besides the others, into the same folder.

    Attributes:
        description: the series' description, as a NAEOTOM Alpha writes it.
        image_type: its fourth value.
        above_water: factor of the Hounsfield units above 0, as these depend on the energy.
        suffix: the suffix of its files.
    """

    description: str
    image_type: str
    above_water: float
    suffix: str = ".dcm"


# Of a NAEOTOM Alpha, as programs tell that read its exports: slices that overlap, other grey values, one geometry.
PRODUCTS = (
    Product("MonoEnergeticPlus 70 keV", "VMI", 1.0),
    Product("ProtocolModel WFBP_T1 Qr40f(3) 0.4 (0.4) [A,1]_0", "NONE", 1.12, ".ima"),
    Product("VNC", "MAT_REMOVED", 0.6, ".ima"),
)
_THICKNESS = 1.5  # of a slice, as a multiple of the distance between slices, where there are several products


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
    parser.add_argument(
        "--products",
        action="store_true",
        help="deliver the products of one acquisition of a photon-counting suite, with overlapping slices, together",
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
    if announce_it and args.when_told and not wait_for_line():
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
        if args.products:
            write_products(target, volume, grid, T_ct_grid, series, faults=args.faults)
        else:
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
    product: Product | None = None,
) -> None:
    """Write volume (K, J, I) as one DICOM file per slice; as a product of an acquisition, if one is given.

    `T_ct_grid` is rigid, with its origin at the centre of voxel (0, 0, 0). Faults of the device `ct`: on `slice` drop
    (a gap), truncate, corrupt, duplicate, tilt, disk_full; on `series` localiser.
    """
    common = _common(volume.shape, grid, T_ct_grid, series)
    prefix, suffix = "CT", ".dcm"
    if product is not None:
        _of_product(common, product, series)
        prefix, suffix = f"P{PRODUCTS.index(product)}_", product.suffix
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
            path = folder / f"{prefix}{number:05d}{suffix}"
            _write_slice(path, common, volume[k], position, number, syntax, tilted=kind == "tilt")
        if kind in ("truncate", "corrupt"):
            data = path.read_bytes()
            path.write_bytes(data[: len(data) // 2] if kind == "truncate" else b"\0" * 200 + data[200:])
    if (fault := faults.check("ct", "series")) is not None and fault.kind == "localiser":
        number += 1
        common.ImageType = ["ORIGINAL", "PRIMARY", "LOCALIZER"]
        position = mm(T_ct_grid[:3, 3])
        _write_slice(
            folder / f"{prefix}{number:05d}{suffix}", common, volume[0], position, number, syntax, tilted=True
        )


def write_products(
    folder: Path,
    volume: NDArray[np.int16],
    grid: Grid,
    T_ct_grid: Array,
    series: str,
    *,
    products: Sequence[Product] = PRODUCTS,
    faults: FaultPlan,
) -> None:
    """Write volume (K, J, I) as the products of one acquisition, as `write_series` does, all into one folder.

    Each slice is as thick as `_THICKNESS` steps, so it overlaps its neighbours and mixes their values.
    """
    beside = (_THICKNESS - 1.0) / 2.0
    above, below = (np.concatenate(pair) for pair in ((volume[:1], volume[:-1]), (volume[1:], volume[-1:])))
    thick = (volume + beside * (above.astype(np.float32) + below)) / _THICKNESS
    for product in products:
        values = np.where(thick > 0, thick * product.above_water, thick)
        write_series(
            folder, np.round(values).astype(np.int16), grid, T_ct_grid, series, faults=faults, product=product
        )


def _of_product(common: Dataset, product: Product, series: str) -> None:
    """Change the elements of a slice to those of a product of the acquisition."""
    common.SeriesInstanceUID = generate_uid(entropy_srcs=[series, product.description])
    common.SeriesDescription = product.description
    common.SeriesNumber = 2 + PRODUCTS.index(product)
    common.ImageType = [*common.ImageType, product.image_type]
    common.SliceThickness = _decimal(_THICKNESS * float(common.SliceThickness))
    common.ConvolutionKernel, common.KVP = "Qr40f", 140
    common.ImagesInAcquisition = len(PRODUCTS) * common.ImagesInAcquisition


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
