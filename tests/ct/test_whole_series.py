"""Whether a CT series without a gap is whole: what its files state of numbers, parts and counts tells part of it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pydicom
import pydicom.data
import pytest
from pydicom.dataset import Dataset
from pydicom.uid import generate_uid

from drivers.dicom_folder import DicomFolderConfig
from drivers.dicom_folder.folder import DicomFolder
from drivers.errors import UnreadableFileError
from drivers.interfaces import CtSeries
from simulators.ct_suite.suite import write_series as simulated_series
from simulators.ct_suite.volume import Grid
from simulators.faults import FaultPlan
from tests.support.ct.ct_series import SHAPE, Change, enhanced_of, hospital, write_series

# Five slices of a scanner of GE, numbered 6 to 10.
SHIPPED = Path(pydicom.data.__file__).parent / "test_files" / "dicomdirtests" / "98892001" / "CT5N"


def source(folder: Path, first_number: int = 1) -> DicomFolder:
    return DicomFolder(DicomFolderConfig(folder=folder, stable_s=0.0, first_number=first_number))


def only(folder: Path, first_number: int = 1) -> CtSeries:
    (series,) = source(folder, first_number).series()
    return series


def stated(**values: object) -> Change:
    def change(ds: Dataset, k: int) -> None:
        for name, value in values.items():
            setattr(ds, name, value)

    return change


def enhanced(slices: Path, target: Path, uid: str, part: tuple[int, int] | None = None) -> None:
    """Let highdicom write single slices as one multi-frame file, which may be a part of several."""
    file = enhanced_of(slices, uid)
    if part is not None:
        file.ConcatenationUID = f"{uid[:60]}.9"
        file.InConcatenationNumber, file.InConcatenationTotalNumber = part
    target.mkdir(exist_ok=True)
    file.save_as(target / f"enhanced{0 if part is None else part[0]}.dcm")


def test_half_a_series_without_a_gap_is_known_by_the_number_that_it_states(tmp_path: Path) -> None:
    change = stated(NumberOfSeriesRelatedInstances=SHAPE[0])
    write_series(tmp_path / "whole", uid="1.2.3", change=change)
    write_series(tmp_path / "half", uid="1.2.4", change=change, skip=(3, 4))
    whole, half = source(tmp_path).series()
    assert whole.problems == ()
    assert half.problems == ("incomplete: 3 of the 5 files that the series states",)
    with pytest.raises(UnreadableFileError, match="incomplete: 3 of the 5 files"):
        source(tmp_path).read(half)


@pytest.mark.parametrize("rotation", [np.eye(3), np.diag([1.0, 1.0, -1.0])])  # numbers grow or fall along the normal
def test_a_series_whose_first_slices_are_missing_is_known_by_its_numbers(
    tmp_path: Path, rotation: np.ndarray[tuple[int, ...], np.dtype[np.float64]]
) -> None:
    write_series(tmp_path, rotation=rotation, skip=(0, 1))
    (problem,) = only(tmp_path).problems
    assert problem.startswith("incomplete: its slices are numbered 3 to 5, not from 1")
    with pytest.raises(UnreadableFileError, match="numbered 3 to 5"):
        source(tmp_path).read(only(tmp_path))
    assert "first_number: 3" in problem
    assert only(tmp_path, first_number=3).problems == ()
    assert source(tmp_path, first_number=3).read(only(tmp_path)).hounsfield.shape[0] == 3


def test_a_part_of_a_real_series_is_known_by_its_numbers(tmp_path: Path) -> None:
    shutil.copytree(SHIPPED, tmp_path / "CT5N")
    (problem,) = only(tmp_path).problems
    assert "numbered 6 to 10" in problem
    assert only(tmp_path, first_number=6).problems == ()


@pytest.mark.parametrize(
    "number", [lambda k: k, lambda k: 2 * k + 3, lambda k: 7, lambda _k: None], ids=["zero", "odd", "one", "none"]
)
def test_numbers_that_do_not_count_the_slices_say_nothing(tmp_path: Path, number: object) -> None:
    assert callable(number)

    def renumber(ds: Dataset, k: int) -> None:
        ds.InstanceNumber = number(k)

    write_series(tmp_path, change=renumber)
    assert only(tmp_path).problems == ()


def test_frames_keep_the_numbers_that_they_had_as_slices(tmp_path: Path) -> None:
    write_series(tmp_path / "slices", change=hospital, skip=(0, 1))
    enhanced(tmp_path / "slices", tmp_path / "enhanced", generate_uid())
    assert "numbered 3 to 5" in " ".join(only(tmp_path / "enhanced").problems)


@pytest.mark.parametrize(("total", "missing"), [(2, 1), (2, 2), (None, 1)])
def test_a_missing_file_of_several_with_frames_is_known_by_its_number(
    tmp_path: Path, total: int | None, missing: int
) -> None:
    target, uid, source_uid = tmp_path / "enhanced", generate_uid(), generate_uid()
    for part, skip in ((1, (3, 4)), (2, (0, 1, 2))):
        write_series(tmp_path / str(part), change=hospital, skip=skip, uid=source_uid)
        enhanced(tmp_path / str(part), target, uid, (part, 2))
    for path in target.iterdir():
        file = pydicom.dcmread(path)
        file.InConcatenationTotalNumber = total
        file.save_as(path)
    assert only(target).problems == ()
    (target / f"enhanced{missing}.dcm").unlink()
    assert "incomplete: 1 of the 2 files of which it consists" in " ".join(only(target).problems)


def test_the_doctor_counts_the_slices_of_each_usable_series(tmp_path: Path) -> None:
    write_series(tmp_path / "whole", uid="1.2.3")
    write_series(tmp_path / "short", uid="1.2.4", skip=(3, 4))
    write_series(tmp_path / "half", uid="1.2.5", skip=(0, 1))
    assert source(tmp_path).report().details["usable"] == "2, of 5, 3 slices"


def test_an_acquisition_that_was_reconstructed_into_two_series_is_no_half_series(tmp_path: Path) -> None:
    write_series(tmp_path / "one", change=stated(AcquisitionNumber=4, ImagesInAcquisition=2 * SHAPE[0]), uid="1.2.3")
    write_series(tmp_path / "none", uid="1.2.4")
    one, none = source(tmp_path).series()
    assert (one.problems, one.acquired_images) == ((), 2 * SHAPE[0])
    assert none.acquired_images is None


def test_two_acquisitions_in_one_series_are_counted_together(tmp_path: Path) -> None:
    def change(ds: Dataset, k: int) -> None:
        ds.AcquisitionNumber, ds.ImagesInAcquisition = (1, 2) if k < 2 else (2, 3)

    write_series(tmp_path, change=change)
    assert only(tmp_path).acquired_images == SHAPE[0]


def test_the_simulated_suite_numbers_slices_as_a_scanner_does(tmp_path: Path) -> None:
    volume = np.full((6, 4, 4), -1000, dtype=np.int16)
    lost = FaultPlan.parse('[{"device": "ct", "on": "slice", "nth": 1, "kind": "drop"}]')
    for name, faults in (("whole", FaultPlan()), ("half", lost)):
        (tmp_path / name).mkdir()
        simulated_series(
            tmp_path / name, volume, Grid(np.eye(4), 1e-3, (6, 4, 4)), np.eye(4), f"1.2.{len(name)}", faults=faults
        )
    whole, half = sorted(source(tmp_path).series(), key=lambda series: len(series.problems))
    assert (whole.problems, whole.acquired_images) == ((), 6)
    assert "numbered 2 to 6" in " ".join(half.problems)
