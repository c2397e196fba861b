"""The CT suite's folder: geometry, gaps, odd series, and files from several manufacturers that pydicom ships."""

from __future__ import annotations

import base64
import resource
import shutil
from pathlib import Path

import numpy as np
import pydicom.data
import pytest
import trimesh
from pydicom.dataset import Dataset
from pydicom.encaps import encapsulate
from pydicom.pixels.decoders.base import get_decoder
from pydicom.uid import (
    UID,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    JPEGLosslessSV1,
    RLELossless,
    generate_uid,
)
from scipy.spatial.transform import Rotation

from drivers.dicom_folder import DRIVER, DicomFolderConfig
from drivers.dicom_folder.folder import DicomFolder
from drivers.errors import DeviceUnavailableError, UnreadableFileError
from drivers.interfaces import Array, CtSeries
from tests.support.ct.ct_series import SHAPE, SPACING_MM, Change, pixels, write_series

# Only files in the package itself; get_testdata_file would look for others on the network.
SHIPPED = Path(pydicom.data.__file__).parent / "test_files"


def source(folder: Path, first_number: int = 1) -> DicomFolder:
    return DicomFolder(DicomFolderConfig(folder=folder, stable_s=0.0, first_number=first_number))


def only(folder: Path) -> CtSeries:
    (series,) = source(folder).series()
    return series


OBLIQUE = Rotation.from_euler("xyz", [0.6, -2.1, 2.9]).as_matrix()


@pytest.mark.parametrize("rotation", [np.eye(3), OBLIQUE, np.diag([-1.0, -1.0, 1.0]), np.diag([1.0, -1.0, -1.0])])
@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, ImplicitVRLittleEndian, RLELossless])
def test_voxels_lie_where_the_headers_say(tmp_path: Path, rotation: Array, syntax: UID) -> None:
    T = write_series(tmp_path / "nested" / "deep", rotation=rotation, syntax=syntax, reverse=True)
    series = only(tmp_path)
    assert series.problems == ()
    volume = source(tmp_path).read(series)
    np.testing.assert_allclose(volume.T_ct_voxel, T, atol=1e-9)
    np.testing.assert_allclose(volume.spacing_m, np.array(SPACING_MM) * 1e-3)
    np.testing.assert_array_equal(volume.hounsfield, pixels() * 2 - 1000)
    assert np.linalg.det(volume.T_ct_voxel[:3, :3]) > 0


def test_slices_numbered_against_the_normal_stay_right_handed(tmp_path: Path) -> None:
    # A left-handed series (k against row × column) must give the same body in space, re-sorted.
    mirrored = OBLIQUE @ np.diag([1.0, 1.0, -1.0])
    T = write_series(tmp_path, rotation=mirrored)
    volume = source(tmp_path).read(only(tmp_path))
    assert np.linalg.det(volume.T_ct_voxel[:3, :3]) > 0
    last = SHAPE[0] - 1
    np.testing.assert_allclose(volume.T_ct_voxel @ [1, 2, 0, 1], T @ [1, 2, last, 1], atol=1e-9)
    np.testing.assert_array_equal(volume.hounsfield[0], pixels()[last] * 2 - 1000)


def test_a_tilted_gantry_is_sheared_as_it_is(tmp_path: Path) -> None:
    def tilt(ds: Dataset, k: int) -> None:
        ds.ImagePositionPatient = [0, 0.2 * k, 0.6 * k]

    write_series(tmp_path, change=tilt)
    volume = source(tmp_path).read(only(tmp_path))
    np.testing.assert_allclose(volume.T_ct_voxel[:3, 2], [0, 0.2e-3, 0.6e-3], atol=1e-12)


def set_tag(name: str, value: object, at: int | None = None) -> Change:
    def change(ds: Dataset, k: int) -> None:
        if at is None or k == at:
            setattr(ds, name, value)

    return change


def drop_tag(name: str) -> Change:
    def change(ds: Dataset, k: int) -> None:
        if k == 1:
            delattr(ds, name)

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (set_tag("ImageType", ["ORIGINAL", "PRIMARY", "LOCALIZER"], at=0), "localiser"),
        (set_tag("ImageOrientationPatient", [1, 0, 0, 0, 0, 1], at=2), "mixed orientation"),
        (set_tag("ImageOrientationPatient", [1, 0, 0, 0.5, 0.5, 0]), "perpendicular"),
        (set_tag("ImagePositionPatient", [12.5, -40.25, 7.6], at=2), "duplicate"),
        (set_tag("ImagePositionPatient", [12.5, -40.25, 8.4], at=2), "uneven spacing"),
        (set_tag("ImagePositionPatient", [13.5, -40.25, 8.2], at=2), "on a line"),
        (set_tag("PixelSpacing", [0.5, 0.41], at=3), "mixed pixel spacing"),
        (set_tag("Modality", "MR"), "not CT"),
        (set_tag("NumberOfFrames", 2), "multi-frame"),
        (drop_tag("ImagePositionPatient"), "no position"),
        (drop_tag("RescaleIntercept"), "no rescale"),
    ],
)
def test_problems_are_named_and_the_series_is_not_read(tmp_path: Path, change: Change, words: str) -> None:
    write_series(tmp_path, change=change)
    series = only(tmp_path)
    assert words in " ".join(series.problems)
    with pytest.raises(UnreadableFileError, match=words) as caught:
        source(tmp_path).read(series)
    assert series.uid in caught.value.where
    assert caught.value.remedy
    assert len(list(tmp_path.iterdir())) == SHAPE[0]


def test_a_gap_is_flagged_with_slices_and_positions(tmp_path: Path) -> None:
    write_series(tmp_path, skip=(2,))
    (problem,) = only(tmp_path).problems
    assert problem.startswith("gap: 1 slices of 0.600 mm missing between I0001")
    assert "7.600 mm" in problem
    assert "8.800 mm" in problem


def test_a_truncated_slice_is_named(tmp_path: Path) -> None:
    write_series(tmp_path)
    victim = tmp_path / "I0003"
    victim.write_bytes(victim.read_bytes()[:-20])
    series = only(tmp_path)
    with pytest.raises(UnreadableFileError, match=r"I0003|cannot be decoded"):
        source(tmp_path).read(series)


def test_several_series_strangers_and_a_changed_folder(tmp_path: Path) -> None:
    write_series(tmp_path / "a", uid="1.2.3")
    write_series(tmp_path / "b", uid="1.2.4", skip=(1,))
    shutil.copy(SHIPPED / "dicomdirtests" / "DICOMDIR", tmp_path / "DICOMDIR")
    (tmp_path / "notes.txt").write_text("out at 10:30")
    (tmp_path / "broken.dcm").write_bytes(b"this is no DICOM file, whatever its name says" * 20)
    ct = source(tmp_path)
    assert [(s.uid, bool(s.problems)) for s in ct.series()] == [("1.2.3", False), ("1.2.4", True)]
    problems = " ".join(ct.report().problems)
    assert "broken.dcm" in problems
    assert "DICOMDIR" not in problems
    assert "notes.txt" not in problems
    (tmp_path / "a" / "I0002").unlink()
    assert "gap" in ct.series()[0].problems[0]


def test_a_segmented_mesh_is_imported(tmp_path: Path) -> None:
    write_series(tmp_path)
    trimesh.creation.icosphere(subdivisions=2, radius=80.0).export(tmp_path / "segmented.stl")
    ct = source(tmp_path)
    (export,) = ct.segmented_meshes()
    assert ct.read_mesh(export).unit == "mm"
    assert only(tmp_path).problems == ()


def test_a_missing_folder_is_a_missing_device(tmp_path: Path) -> None:
    with pytest.raises(DeviceUnavailableError):
        DRIVER.build(DRIVER.config.model_validate({"folder": tmp_path / "none"})).open()


# Files that pydicom ships, from scanners of several manufacturers


def test_shipped_scan_of_five_slices(tmp_path: Path) -> None:
    shutil.copytree(SHIPPED / "dicomdirtests" / "98892001" / "CT5N", tmp_path / "CT5N")
    ct = source(tmp_path, first_number=6)  # the slices before it were not shipped
    (series,) = ct.series()
    assert (series.slices, series.problems, series.modality) == (5, (), "CT")
    volume = ct.read(series)
    assert volume.hounsfield.shape == (5, 16, 16)
    assert volume.spacing_m[2] == pytest.approx(2.5e-3)
    assert np.linalg.det(volume.T_ct_voxel[:3, :3]) > 0
    assert volume.hounsfield.min() >= -32768


def test_shipped_scan_with_missing_slices(tmp_path: Path) -> None:
    shutil.copytree(SHIPPED / "dicomdirtests" / "77654033" / "CT2", tmp_path / "CT2")
    (problem,) = only(tmp_path).problems
    assert "161 slices of 1.250 mm missing between 17106" in problem


def test_shipped_localisers(tmp_path: Path) -> None:
    shutil.copytree(SHIPPED / "dicomdirtests" / "98892001" / "CT2N", tmp_path / "CT2N")
    assert "localiser" in " ".join(only(tmp_path).problems)


@pytest.mark.parametrize("name", ["CT_small.dcm", "693_J2KI.dcm", "J2K_pixelrep_mismatch.dcm"])
def test_shipped_single_slices_lack_a_spacing(tmp_path: Path, name: str) -> None:
    shutil.copy(SHIPPED / name, tmp_path / name)
    assert "only one slice" in " ".join(only(tmp_path).problems)


@pytest.mark.parametrize("name", ["CT_small.dcm", "693_J2KI.dcm"])
def test_shipped_slices_uncompressed_and_jpeg_2000_decode_in_a_series(tmp_path: Path, name: str) -> None:
    # A second slice of the same file, one spacing further, makes it a series.
    ds = pydicom.dcmread(SHIPPED / name)
    ds.save_as(tmp_path / "1.dcm")
    ds.SOPInstanceUID = ds.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    row, column = np.array(ds.ImageOrientationPatient, dtype=np.float64).reshape(2, 3)
    position = np.array(ds.ImagePositionPatient, dtype=np.float64) + 5.0 * np.cross(row, column)
    ds.ImagePositionPatient = [f"{x:.6f}" for x in position]
    ds.save_as(tmp_path / "2.dcm")
    volume = source(tmp_path).read(only(tmp_path))
    expected = np.rint(ds.pixel_array * float(ds.RescaleSlope) + float(ds.RescaleIntercept))
    np.testing.assert_array_equal(volume.hounsfield[1], expected)
    assert volume.hounsfield.min() < -500


def test_every_shipped_file_is_listed_or_named_but_never_a_crash(tmp_path: Path) -> None:
    shutil.copytree(SHIPPED, tmp_path / "all", ignore=shutil.ignore_patterns("*.json", "*.txt"))
    ct = source(tmp_path, first_number=6)
    series = ct.series()
    assert sum(one.slices for one in series) > 100
    usable = [one for one in series if not one.problems]
    assert [one.slices for one in usable] == [5]
    report = ct.report()
    for one in series:
        if one.modality == "MR":
            assert any("not CT" in problem for problem in one.problems)
    assert any("icc" in problem for problem in report.problems)


def test_a_series_in_transfer_is_not_taken_for_a_short_one(tmp_path: Path) -> None:
    """Its first slices look like a complete series; only waiting shows that it is not."""
    now_s = 100.0
    folder = DicomFolder(DicomFolderConfig(folder=tmp_path, stable_s=5.0), monotonic=lambda: now_s)
    uid = generate_uid()
    write_series(tmp_path, skip=(3, 4), uid=uid)
    (series,) = folder.series()
    assert "still arriving" in series.problems[0]
    now_s += 4.0
    write_series(tmp_path, skip=(0, 1, 2), uid=uid)
    now_s += 2.0  # six seconds after the first slices, but more slices came later
    assert "still arriving" in folder.series()[0].problems[0]
    now_s += 5.1
    (series,) = folder.series()
    assert series.problems == ()
    assert series.slices == SHAPE[0]
    assert folder.report().problems == ()


def test_images_larger_than_any_slice_are_a_problem_before_memory_is_set_aside(tmp_path: Path) -> None:
    def huge(image: Dataset, k: int) -> None:
        if k == 2:
            image.Rows = image.Columns = 60_000

    write_series(tmp_path, change=huge)
    (series,) = source(tmp_path).series()
    assert any("more than 67,108,864 pixels" in problem for problem in series.problems), series.problems


def test_a_length_of_four_gigabytes_asks_for_no_more_than_the_file_holds(tmp_path: Path) -> None:
    meta = b"\2\0\x10\0UI\x14\0" + str(ImplicitVRLittleEndian).encode().ljust(20, b"\0")
    data = b"\0" * 128 + b"DICM" + meta + b"\x08\0\x18\0\xf0\xff\xff\xff" + b"1.2"
    (tmp_path / "CT00001.dcm").write_bytes(data)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + (1 << 30), hard))
    try:
        assert source(tmp_path).series() == ()
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


# The slices of `write_series` as written by GDCM's encoder: JPEG Lossless with first-order prediction.
LOSSLESS = [
    "/9j/wwALEAAGAAgBAREA/8QAFgABAQEAAAAAAAAAAAAAAAAAAQQQ/9oACAEBAAEAAMqq0KqtCqrQqq0KqtCqr//Z",
    *(
        f"/9j/wwALEAAGAAgBAREA/8QAFgABAQEAAAAAAAAAAAAAAAAAAQQP/9oACAEBAAEAAMA{first}1VWhVVoVVaFVWhVVoVVf/9k="
        for first in "LXjv"
    ),
]


def test_a_lossless_series_is_read_where_a_decoder_is_and_told_of_before_where_none_is(tmp_path: Path) -> None:
    def compressed(ds: Dataset, k: int) -> None:
        ds.PixelData = encapsulate([base64.b64decode(LOSSLESS[k])])
        ds["PixelData"].is_undefined_length = True

    write_series(tmp_path, syntax=JPEGLosslessSV1, change=compressed)
    (series,) = source(tmp_path).series()
    if get_decoder(JPEGLosslessSV1).is_available:  # with the extra package
        assert not series.problems
        np.testing.assert_array_equal(source(tmp_path).read(series).hounsfield, 2 * pixels() - 1000)
        return
    (problem,) = series.problems
    assert "compressed as JPEG Lossless" in problem
    assert "pip install python-gdcm" in problem
