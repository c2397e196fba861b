"""The contents of the scanner and CT folders in a case, made once for all cases."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import trimesh

from service.core.geometry import Array, transform
from simulators.ct_suite.suite import write_series
from simulators.ct_suite.volume import Grid
from simulators.faults import Fault, FaultPlan
from tests.support.scenes.sphere_images import REGISTRATION_M
from tests.support.scenes.sphere_meshes import MeshBuilder, cap

SCAN, CT = "scan.ply", "ct"
FIVE = "five.ply"
_VOXEL_M, _SHAPE = 1.5e-3, (56, 72, 96)
_CENTRES_MM = np.array([[24, 28, 26], [70, 32, 44], [118, 24, 31], [37, 80, 58], [104, 76, 22]], dtype=np.float64)
_AIR, _PLASTIC = -1000, 120


def make_material(folder: Path) -> None:
    """Make exports of ten, eight and five spheres, and a CT series of the same five."""
    folder.mkdir()
    rng = np.random.default_rng(3)
    for name, centres in ((SCAN, REGISTRATION_M), ("eight.ply", REGISTRATION_M[:8]), (FIVE, _CENTRES_MM * 1e-3)):
        built = MeshBuilder()
        for centre in centres:
            built.add(*cap(centre, 1.3, rng, level=4, white_m=2e-5))
        vertices, faces = built.build()
        trimesh.Trimesh(1e3 * vertices, faces, process=False).export(folder / name)
    write_ct(folder / CT, _CENTRES_MM, "1.2.3.4")


def write_ct(folder: Path, centres_mm: Array, series: str, plan: tuple[Fault, ...] = ()) -> None:
    """Write a CT series with spheres of 15 mm radius at these centres (N, 3)."""
    folder.mkdir(exist_ok=True)
    k, j, i = np.meshgrid(*(np.arange(n) * _VOXEL_M * 1e3 for n in _SHAPE), indexing="ij")
    inside = np.full(_SHAPE, -np.inf)
    for x, y, z in centres_mm:
        inside = np.maximum(inside, 15.0 - np.sqrt((i - x) ** 2 + (j - y) ** 2 + (k - z) ** 2))
    share = np.clip(inside / (_VOXEL_M * 1e3) + 0.5, 0.0, 1.0)  # fraction of a voxel inside plastic
    volume = (_AIR + share * (_PLASTIC - _AIR)).astype(np.int16)
    frame = transform(np.eye(3), np.zeros(3))
    write_series(folder, volume, Grid(frame, _VOXEL_M, _SHAPE), frame, series, faults=FaultPlan(plan))


def scan_folder(folder: Path, material: Path, name: str = SCAN) -> None:
    """Fill the scanner's folder with one export."""
    folder.mkdir(exist_ok=True)
    shutil.copy(material / name, folder / SCAN)


def ct_folder(folder: Path, material: Path) -> None:
    """Fill the CT folder with one series."""
    shutil.copytree(material / CT, folder, dirs_exist_ok=True)


def spoilt_ct(folder: Path, kind: str) -> None:
    """Fill the CT folder with a faulty series."""
    fault = Fault(
        device="ct", on="series" if kind == "localiser" else "slice", kind=kind, nth=1 if kind == "localiser" else 12
    )
    write_ct(folder, _CENTRES_MM, "1.2.3.4", (fault,))


def mirrored_ct(folder: Path) -> None:
    """Write a series mirrored left to right, as by some export programs."""
    mirrored = _CENTRES_MM.copy()
    mirrored[:, 0] = (_SHAPE[2] - 1) * _VOXEL_M * 1e3 - mirrored[:, 0]
    write_ct(folder, mirrored, "1.2.3.4")


def other_ct(folder: Path) -> None:
    """Add a second series, of another specimen with two spheres."""
    write_ct(folder / "other", _CENTRES_MM[:2] + 3.0, "1.2.3.9")
