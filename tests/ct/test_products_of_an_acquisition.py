"""One folder with several products of one acquisition, as a photon-counting CT suite delivers it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from PIL import Image
from pydicom.uid import generate_uid

from drivers.dicom_folder import DicomFolderConfig
from drivers.dicom_folder.folder import DicomFolder
from drivers.interfaces import CtSource
from service.core.errors import DataError
from service.core.records.run_events import FilesKept
from service.import_folder import CtReading, ImportFolders, import_rig, list_import
from simulators.ct_suite.suite import PRODUCTS, Product, write_products
from simulators.ct_suite.volume import Grid
from simulators.faults import FaultPlan
from tests.support.rig.bench_rig import BenchRig, answer
from tests.support.runs.bench_run import Bench, bench_store
from tests.support.runs.computing_run import begin_computing_run

SHAPE = (6, 8, 10)  # K, J, I
STEP_M = 0.4e-3
PROTOCOL = """\
id: products
version: "1"
title: A CT of several products
spheres: {radius_mm: 6, registration: 5, control: 0}
camera: {aperture_f: 22, exposure_s: 1/50, iso: 100}
steps:
  - id: ct
    kind: ct_import
    title: CT
    confirm: false
    params: {spheres: 5, wait_s: 5}
    recovery: {retries: 0, wait_s: 0}
"""


def deliver(folder: Path, series: str = "1.2.3", products: Sequence[Product] = PRODUCTS) -> None:
    """Deliver slices of air, with water in their middle and bone in one voxel."""
    folder.mkdir(exist_ok=True)
    volume = np.full(SHAPE, -1000, dtype=np.int16)
    volume[2:4, 3:6, 3:6] = 0
    volume[:, 4, 4] = 1000
    grid = Grid(np.eye(4), STEP_M, SHAPE)
    write_products(folder, volume, grid, np.eye(4), series, products=products, faults=FaultPlan())


def source(folder: Path, wanted: str = "") -> DicomFolder:
    return DicomFolder(DicomFolderConfig(folder=folder, stable_s=0.0, series=wanted))


def test_each_product_is_a_series_of_its_own_though_their_slices_overlap(tmp_path: Path) -> None:
    deliver(tmp_path)
    found = source(tmp_path).series()
    assert {one.description for one in found} == {product.description for product in PRODUCTS}
    assert len({one.frame_of_reference for one in found}) == 1
    for one in found:
        assert (one.problems, one.slices) == ((), SHAPE[0])
        volume = source(tmp_path).read(one)
        assert volume.spacing_m[2] == pytest.approx(STEP_M), "the step between slices, not their thickness"


@pytest.mark.parametrize(("wanted", "bone_hu"), [("70 kev", 1000), ("WFBP_T1", 1120), ("vnc", 600)])
def test_the_product_that_the_rig_names_is_the_one_that_is_there(tmp_path: Path, wanted: str, bone_hu: int) -> None:
    deliver(tmp_path)
    ct = source(tmp_path, wanted)
    (series,) = ct.series()
    assert ct.read(series).hounsfield[:, 4, 4].tolist() == [bone_hu] * SHAPE[0]
    report = ct.report()
    assert report.problems == ()
    assert report.details["series to use"] == wanted
    others = {product.description for product in PRODUCTS} - {series.description}
    assert all(other in report.details["not used"] for other in others)
    assert series.description not in report.details["not used"]
    assert report.details["usable"] == "1, of 6 slices"


def test_a_product_that_is_not_there_is_said_with_those_that_are(tmp_path: Path) -> None:
    deliver(tmp_path)
    ct = source(tmp_path, "iodine")
    assert ct.series() == ()
    (problem,) = ct.report().problems
    assert "no series has a description with 'iodine'" in problem
    assert "'MonoEnergeticPlus 70 keV'" in problem


def test_several_series_are_ordered_by_when_they_were_written(tmp_path: Path) -> None:
    for number, name in enumerate(("9.1", "1.1", "5.1")):
        deliver(tmp_path / name, name, PRODUCTS[:1])
        for file in (tmp_path / name).iterdir():
            os.utime(file, (1.7e9 + number, 1.7e9 + number))
    found = source(tmp_path).series()
    assert [one.files[0].parent.name for one in found] == ["9.1", "1.1", "5.1"]


@pytest.mark.slow
def test_an_import_takes_the_product_that_is_named_and_names_them_all_otherwise(tmp_path: Path) -> None:
    deliver(tmp_path / "ct")
    for role, grey in (("calibration", 90), ("image", 120)):
        (tmp_path / role).mkdir()
        Image.new("RGB", (48, 32), (grey, grey, grey)).save(tmp_path / role / f"{role}.jpg")
    places = ImportFolders(tmp_path, tmp_path / "calibration", tmp_path / "image", ct=tmp_path / "ct")
    with pytest.raises(DataError, match=r"3 CT series: .*MonoEnergeticPlus 70 keV.*VNC.*--ct-series"):
        list_import(places)
    wanted = CtReading(series="VNC")
    listing = list_import(places, ct=wanted)
    assert len(listing.files["ct"]) == SHAPE[0]
    assert all(Path(file.path).name.startswith("P2_") for file in listing.files["ct"])
    assert import_rig(listing, simulated=True, ct=wanted).section.devices["ct"]["series"] == "VNC"
    with pytest.raises(DataError, match=r"no complete CT series .*no series has a description with 'iodine'"):
        list_import(places, ct=CtReading(series="iodine"))


class OneFolder(BenchRig):
    """The bench with a CT suite's folder."""

    folder: Path

    def ct(self) -> CtSource:
        return cast(CtSource, source(self.folder))


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    rig = OneFolder()
    rig.folder = tmp_path / "ct"
    deliver(rig.folder, generate_uid())
    with bench_store(tmp_path / "data") as store:
        yield begin_computing_run(store, PROTOCOL, tmp_path, rig)


def test_a_person_is_asked_which_of_several_products_it_is_and_takes_the_others_away(bench: Bench) -> None:
    rig = cast(OneFolder, bench.rig)
    asked: list[str] = []

    def choose(question: Any, _state: Any) -> Any:
        asked.append(question.text)
        for file in rig.folder.iterdir():
            if not file.name.startswith("P0_"):
                file.unlink()
        return answer(question, "confirm")

    def enough(question: Any, _state: Any) -> Any:
        return answer(question, "abort", reason="no spheres are in it")

    bench.script("ct", "recovery", choose, enough)
    bench.run()
    assert "3 series show the specimen in the same frame of reference" in asked[0]
    assert all(product.description in asked[0] for product in PRODUCTS)
    assert "Take the others out of the CT folder" in asked[0]
    kept = [event.payload for event in bench.store.events(bench.run_id) if isinstance(event.payload, FilesKept)]
    assert sum(ref.kind == "ct_slice" for payload in kept for ref in payload.artefacts) == SHAPE[0]
