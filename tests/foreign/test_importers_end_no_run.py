"""Whatever a file makes a library raise, the step fails, the file is named, and the run waits for a person."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import pydicom
import pytest

from drivers.dicom_folder import DicomFolderConfig
from drivers.dicom_folder.folder import DicomFolder
from drivers.errors import UnreadableFileError
from drivers.interfaces import CtSource, Scanner
from drivers.photos.photo_file import exiv2, read_exif
from drivers.scan_folder import ScanFolder, ScanFolderConfig
from service.core.records.import_list import ImportList
from service.core.records.run_events import DeviceOpened, StepFailed
from tests.support.ct.ct_series import write_series
from tests.support.rig.bench_rig import BenchRig
from tests.support.runs.bench_run import Bench, begin_run, bench_store, say
from tests.support.runs.computing_run import OneScanner

HEAD = """\
id: imports
version: "1"
title: Imports
spheres: {radius_mm: 6, registration: 5, control: 0}
camera: {aperture_f: 22, exposure_s: 1/50, iso: 100}
steps:
  - id: import
    title: Import
    confirm: false
    recovery: {retries: 0, wait_s: 0}
"""
STEPS = {
    "scan": "    kind: scan_import\n    params: {spheres: 5, wait_s: 5}\n",
    "ct series": "    kind: ct_import\n    params: {spheres: 5, wait_s: 5}\n",
    "ct segmentation": "    kind: ct_import\n    params: {spheres: 5, source: segmentation, wait_s: 5}\n",
    "ct mesh": "    kind: ct_import\n    params: {spheres: 5, source: mesh, wait_s: 5}\n",
    "photographs": "    kind: image_import\n    params: {photographs: image}\n",
}


class OddError(Exception):
    """Of a library that nobody here has heard of."""


class Raising:
    """A device of which every call raises."""

    def __init__(self, error: Exception) -> None:
        self.error = error

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def raises(*_words: object, **_named: object) -> Any:
            raise self.error

        return raises


class RaisingRig(BenchRig):
    """The bench with importers of which every call raises."""

    error: Exception

    def scanner(self, name: str | None = None) -> Scanner:
        return cast(Scanner, Raising(self.error))

    def ct(self) -> CtSource:
        return cast(CtSource, Raising(self.error))

    def imported(self) -> ImportList | None:
        raise self.error


def failed(bench: Bench) -> StepFailed:
    """Run until a person is asked, who first repeats the step and then ends the run; the last failure."""
    bench.script("import", "recovery", say("confirm"), say("abort", reason="enough"))
    state = bench.run()
    assert state.status == "aborted"
    bench.must_verify()
    _, again = bench.payloads(StepFailed)  # a person was asked, and the step was repeated
    return again


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize(
    "error",
    [
        OddError("an odd one"),
        ModuleNotFoundError("No module named 'charset_normalizer'"),
        UnicodeDecodeError("utf-8", b"\xfc", 0, 1, "invalid start byte"),
        MemoryError("1 TiB"),
        RecursionError("too deep"),
        PermissionError(13, "Permission denied", "IMG_0001.JPG"),
    ],
)
def test_no_error_of_an_importer_ends_the_runner(tmp_path: Path, step: str, error: Exception) -> None:
    rig = RaisingRig()
    rig.error = error
    with bench_store(tmp_path / "data") as store:
        bench = begin_run(store, HEAD + STEPS[step], tmp_path)
        bench.rig = rig
        failure = failed(bench)
    assert failure.error == "UnforeseenError"
    assert failure.recovery == "ask"
    assert type(error).__name__ in failure.message
    if isinstance(error, OSError):
        assert "IMG_0001.JPG" in failure.message


def raising(*_words: object, **_named: object) -> Any:
    raise OddError("an odd one")


def test_a_mesh_that_a_reader_cannot_bear_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.meshes.obj.raw_mesh", raising)
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / "Rücken.obj").write_text("v 0 0 0\nv 300 0 0\nv 0 300 0\nf 1 2 3\n")
    rig = OneScanner()
    rig.folder = tmp_path / "scans"
    with bench_store(tmp_path / "data") as store:
        bench = begin_run(store, HEAD + STEPS["scan"], tmp_path)
        bench.rig = rig
        failure = failed(bench)
    assert failure.error == "UnreadableFileError"
    assert "Rücken.obj" in failure.message
    assert "OddError" in failure.message


class OneCt(BenchRig):
    """The bench with a folder of a CT suite."""

    folder: Path

    def ct(self) -> CtSource:
        return DicomFolder(DicomFolderConfig(folder=self.folder, stable_s=0, mesh_unit="mm"))


def test_a_slice_that_a_reader_cannot_bear_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_series(tmp_path / "ct")
    monkeypatch.setattr(pydicom, "dcmread", raising)
    rig = OneCt()
    rig.folder = tmp_path / "ct"
    with bench_store(tmp_path / "data") as store:
        bench = begin_run(store, HEAD + STEPS["ct series"], tmp_path)
        bench.rig = rig
        failure = failed(bench)
    assert failure.error == "DeviceTimeoutError"  # a series may still arrive
    (first, *_) = sorted((tmp_path / "ct").iterdir())
    assert first.name in failure.message
    assert "OddError" in failure.message


def test_a_photograph_that_a_reader_cannot_bear_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "IMG_0001.JPG"
    path.write_bytes(b"\xff\xd8\xff\xd9")
    monkeypatch.setattr(exiv2, "ImageFactory", Raising(OddError("an odd one")))
    with pytest.raises(UnreadableFileError, match="OddError") as caught:
        read_exif(path)
    assert caught.value.where == str(path)


def test_a_photograph_whose_name_is_no_text_is_named(tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode("Rücken.JPG".encode("latin-1"))
    path.write_bytes(b"\xff\xd8\xff\xd9")
    with pytest.raises(UnreadableFileError, match=r"not UTF-8 text.*Rename") as caught:
        read_exif(path)
    assert "R\\udcfccken.JPG" in caught.value.where


@pytest.mark.parametrize("device", ["scans", "ct"])
def test_a_damaged_file_whose_name_is_no_text_is_reported_and_no_more(tmp_path: Path, device: str) -> None:
    """Its name could be neither printed nor recorded, and with that no file of the folder could be imported."""
    folder = tmp_path / device
    folder.mkdir()
    (folder / os.fsdecode("Rücken.ply".encode("latin-1"))).write_bytes(b"ply\n")
    (folder / os.fsdecode("Rücken.dcm".encode("latin-1"))).write_bytes(b"no slice")
    scans, series = ScanFolder(ScanFolderConfig(folder=folder)), DicomFolder(DicomFolderConfig(folder=folder))
    opened = scans if device == "scans" else series
    opened.open()
    report = opened.report()
    assert len(report.problems) == (1 if device == "scans" else 2)
    assert any("Rücken.ply: the PLY header is cut short" in problem for problem in report.problems)
    with bench_store(tmp_path / "data") as store:
        bench = begin_run(store, HEAD + STEPS["scan"], tmp_path)
        store.record(bench.run_id, [DeviceOpened(device=device, report=asdict(report))], actor="runner")
    "\n".join(report.problems).encode()
