"""A run that imports a CT series with a segmentation: the surface, the mirror trap, and what the record keeps."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray
from pydicom.uid import generate_uid

from drivers.dicom_folder import DicomFolderConfig
from drivers.dicom_folder.folder import DicomFolder
from drivers.interfaces import CtSource
from service.audit.recorded_run import read_run
from service.audit.report import report_content
from service.audit.report_output import render_html
from service.core.geometry import Array, apply, inverse, transform
from service.core.records.run_events import FilesKept
from service.core.run.state import RunState
from service.store.verification.verify import verify
from simulators.ct_suite.suite import write_series
from simulators.ct_suite.volume import Grid
from simulators.faults import FaultPlan
from tests.support.ct.ct_labels import write_nifti
from tests.support.ct.fused_scene import CENTRES_M, RADIUS_M, T_WORLD_CT
from tests.support.rig.bench_rig import BenchRig
from tests.support.runs.bench_run import Bench, bench_store, say
from tests.support.runs.computing_run import begin_computing_run

VOXEL_M = 0.8e-3
FIRST_M = np.array([-0.08, -0.08, 0.0])  # voxel (0, 0, 0) in the world
SHAPE = (80, 200, 200)  # K, J, I
T_CT_GRID = inverse(T_WORLD_CT) @ transform(np.eye(3), FIRST_M)
T_CT_VOXEL = T_CT_GRID @ np.diag([VOXEL_M, VOXEL_M, VOXEL_M, 1.0])
PROTOCOL = """\
id: segmented
version: "1"
title: A segmented CT
spheres: {radius_mm: 6, registration: 5, control: 0}
camera: {aperture_f: 22, exposure_s: 1/50, iso: 100}
steps:
  - id: ct
    kind: ct_import
    title: CT
    confirm: false
    params: {source: segmentation, segments: ["2"], spheres: 5, wait_s: 5}
    gates: [{measure: label_contrast_hu, min: 500, unit: HU}]
    recovery: {retries: 0, wait_s: 0}
"""


def distance_m() -> Array:
    """(K, J, I) signed distance of every voxel from the nearest sphere's surface."""
    k, j, i = np.meshgrid(*map(np.arange, SHAPE), indexing="ij")
    points = np.stack([i, j, k], axis=-1) * VOXEL_M + FIRST_M
    nearest = np.full(SHAPE, np.inf)
    for centre in CENTRES_M:
        nearest = np.minimum(nearest, np.linalg.norm(points - centre, axis=-1))
    return nearest - RADIUS_M


class OneSeries(BenchRig):
    """The bench with a CT suite's folder."""

    folder: Path

    def ct(self) -> CtSource:
        return cast(CtSource, DicomFolder(DicomFolderConfig(folder=self.folder, stable_s=0)))


@pytest.fixture(scope="module")
def spheres(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, NDArray[np.uint8]]:
    """The folder of a series of five spheres in air, and their labels (K, J, I): 2, the voxels inside."""
    folder = tmp_path_factory.mktemp("ct")
    away = distance_m()
    hounsfield = np.clip(-1000 + 1150 * (0.5 - away / VOXEL_M), -1000, 150).astype(np.int16)
    write_series(folder, hounsfield, Grid(np.eye(4), VOXEL_M, SHAPE), T_CT_GRID, generate_uid(), faults=FaultPlan())
    return folder, np.where(away < 0, 2, 0).astype(np.uint8)


@pytest.fixture
def bench(tmp_path: Path, spheres: tuple[Path, NDArray[np.uint8]]) -> Iterator[Bench]:
    rig = OneSeries()
    rig.folder = spheres[0]
    for old in spheres[0].glob("*.nii"):
        old.unlink()
    with bench_store(tmp_path / "data") as store:
        yield begin_computing_run(store, PROTOCOL, tmp_path, rig)


def imported(bench: Bench, spheres: tuple[Path, NDArray[np.uint8]], labels: NDArray[np.uint8]) -> RunState:
    write_nifti(spheres[0] / "labels.nii", T_CT_VOXEL, labels.transpose(2, 1, 0), descrip="DOE")
    return bench.run()


@pytest.mark.slow
def test_the_surface_is_that_of_the_segment_and_the_record_names_nobody(
    bench: Bench, spheres: tuple[Path, NDArray[np.uint8]]
) -> None:
    other = np.where(spheres[1] == 0, 1, 2).astype(np.uint8)  # another segment all around, which is not wanted
    state = imported(bench, spheres, other)
    assert state.status == "completed", state
    ct = state.steps["ct"]
    found = apply(T_WORLD_CT, np.array(ct.result["spheres_m"]))
    away = np.linalg.norm(found[:, None] - CENTRES_M[None], axis=2).min(axis=1)
    assert away.max() < 0.05e-3
    assert ct.measures["radius_residual_max_mm"] < 0.12  # voxels of 0.8 mm, smoothed
    assert ct.measures["label_voxels"] == np.count_nonzero(spheres[1])
    assert ct.measures["label_contrast_hu"] > 1000
    assert ct.measures["cut_by_ends_mm2"] == ct.measures["images_elsewhere"] == 0

    kept = [event.payload for event in bench.store.events(bench.run_id) if isinstance(event.payload, FilesKept)]
    files = [ref for payload in kept for ref in payload.artefacts if ref.kind in ("ct_slice", "ct_segmentation")]
    names = {ref.original_name for ref in files}
    assert names == {"ct_segmentation_00001.nii", *(f"ct_slice_{number:05d}.dcm" for number in range(1, 81))}
    assert all(b"SIMULATED" not in bench.store.artefact_path(ref.sha256).read_bytes() for ref in files)
    first = hashlib.sha256(min(spheres[0].glob("CT*.dcm")).read_bytes()).hexdigest()
    assert any(first in payload.note for payload in kept)
    checked = verify(bench.data, bench.run_id)
    assert checked.first_fault is None
    html = render_html(report_content(read_run(bench.data, bench.run_id), checked, with_pictures=False))
    assert "Personal data: 80 files of the device ct were kept as copies without these attributes" in html
    assert "PatientID, PatientName" in html
    assert "SPECIMEN^SIMULATED" not in html
    assert "NIfTI descrip" in html


@pytest.mark.slow
def test_a_mirrored_segmentation_is_told_from_a_true_one(
    bench: Bench, spheres: tuple[Path, NDArray[np.uint8]]
) -> None:
    bench.operator.script = {("ct", "recovery"): [say("abort", reason="the segmentation is wrong")]}
    imported(bench, spheres, spheres[1][:, :, ::-1])
    (question,) = [asked for asked in bench.operator.asked if asked.for_ == "recovery"]
    assert "it is mirrored: an axis was negated when it was written" in question.text
