"""Segmentations of a CT series: DICOM SEG by highdicom and NIfTI by nibabel, on exactly its voxels or refused."""

from __future__ import annotations

import gzip
import itertools
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pydicom
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drivers.dicom_folder import DicomFolderConfig
from drivers.dicom_folder.folder import DicomFolder
from drivers.errors import UnreadableFileError
from drivers.interfaces import Array, CtLabels
from tests.support.ct.ct_labels import LABELS, LPS_FROM_RAS, write_nifti, write_seg
from tests.support.ct.ct_series import SHAPE, hospital, write_series

OBLIQUE = Rotation.from_euler("xyz", [0.6, -2.1, 2.9]).as_matrix()


def ct(folder: Path) -> DicomFolder:
    return DicomFolder(DicomFolderConfig(folder=folder, stable_s=0.0))


def read(folder: Path, *segments: str) -> CtLabels:
    """The labels of the only segmentation of the only series."""
    driver = ct(folder)
    (series,), (found,) = driver.series(), driver.segmentations()
    return driver.read_labels(found, driver.read(series), segments)


# --- DICOM SEG --------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.sweep
@pytest.mark.parametrize("kind", ["BINARY", "FRACTIONAL", "LABELMAP"])
@pytest.mark.parametrize("rotation", [np.eye(3), OBLIQUE])
def test_a_segmentation_lies_on_the_voxels_it_was_made_of(tmp_path: Path, kind: str, rotation: Array) -> None:
    write_series(tmp_path, change=hospital, rotation=rotation)
    write_seg(tmp_path, kind)
    every, spheres = read(tmp_path), read(tmp_path, "spheres")
    np.testing.assert_array_equal(every.inside, LABELS > 0)
    np.testing.assert_array_equal(spheres.inside, LABELS == 2)
    assert (every.segments, spheres.segments) == (("bone", "spheres"), ("spheres",))
    assert ct(tmp_path).report().problems == ()


def test_a_segment_that_is_not_there_is_named_with_those_that_are(tmp_path: Path) -> None:
    write_series(tmp_path, change=hospital)
    write_seg(tmp_path)
    with pytest.raises(UnreadableFileError, match=r"no segment 'balls' \(there is: bone, spheres\)"):
        read(tmp_path, "balls")


def test_a_segmentation_of_another_frame_of_reference_is_refused(tmp_path: Path) -> None:
    write_series(tmp_path, change=hospital)
    path = write_seg(tmp_path)
    ds = pydicom.dcmread(path)
    ds.FrameOfReferenceUID = "1.2.3"
    ds.save_as(path)
    with pytest.raises(UnreadableFileError, match=r"its frame of reference \(1\.2\.3\) is not that of the series"):
        read(tmp_path)


def test_a_segmentation_between_the_voxels_is_refused(tmp_path: Path) -> None:
    write_series(tmp_path, change=hospital)
    path = write_seg(tmp_path)
    ds = pydicom.dcmread(path)
    for frame in ds.PerFrameFunctionalGroupsSequence:
        x, y, z = frame.PlanePositionSequence[0].ImagePositionPatient
        frame.PlanePositionSequence[0].ImagePositionPatient = [x + 0.2, y, z]  # half a voxel
    ds.save_as(path)
    with pytest.raises(UnreadableFileError, match=r"\(frame 1\) are not those of the CT series.* 0\.50 voxels"):
        read(tmp_path)


# --- NIfTI ------------------------------------------------------------------------------------------------------


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    order=st.permutations([0, 1, 2]),
    signs=st.tuples(*[st.sampled_from([-1, 1])] * 3),
    name=st.sampled_from(["labels.nii", "labels.nii.gz"]),
    kind=st.sampled_from(["u1", "i2", "u2", "i4"]),
)
def test_axes_may_be_in_any_order_and_direction(
    tmp_path_factory: pytest.TempPathFactory, order: list[int], signs: tuple[int, int, int], name: str, kind: str
) -> None:
    folder = tmp_path_factory.mktemp("ct")
    T = write_series(folder, rotation=OBLIQUE)
    voxels = LABELS.transpose(2, 1, 0).astype(kind)  # i, j, k
    turned = np.zeros((4, 4))
    turned[3, 3] = 1
    for new, old in enumerate(order):
        turned[old, new] = signs[new]
        turned[old, 3] = 0 if signs[new] > 0 else voxels.shape[old] - 1
    stored = voxels.transpose(order)[tuple(slice(None, None, sign) for sign in signs)]
    write_nifti(folder / name, T @ turned, stored)
    np.testing.assert_array_equal(read(folder).inside, LABELS > 0)
    np.testing.assert_array_equal(read(folder, "2").inside, LABELS == 2)


def test_a_file_without_the_change_of_axes_is_recognised(tmp_path: Path) -> None:
    T = write_series(tmp_path)
    write_nifti(tmp_path / "labels.nii", LPS_FROM_RAS @ T, LABELS.transpose(2, 1, 0))
    with pytest.raises(UnreadableFileError, match=r"only if x and y are negated.*mirrored or turned"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("T_voxel_block", "words"),
    [
        (np.diag([2.0, 2.0, 2.0, 1.0]), r"have 0\.8 × 1 × 1\.2 mm, those of the series 0\.4 × 0\.5 × 0\.6 mm"),
        (np.array([[1, 0, 0, 0.0], [0, 1, 0, 0], [0, 0, 1, 0.3], [0, 0, 0, 1]]), r"first one is 0\.30 voxels"),
        (np.array([[1, 0, 0, 4.0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), r"lie outside the CT series"),
    ],
)
def test_other_voxels_are_refused_and_described(tmp_path: Path, T_voxel_block: Array, words: str) -> None:
    T = write_series(tmp_path)
    write_nifti(tmp_path / "labels.nii", T @ T_voxel_block, LABELS.transpose(2, 1, 0))
    with pytest.raises(UnreadableFileError, match=words):
        read(tmp_path)


def test_a_file_that_is_cut_short_waits_and_an_image_is_no_segmentation(tmp_path: Path) -> None:
    T = write_series(tmp_path)
    path = tmp_path / "labels.nii.gz"
    write_nifti(path, T, LABELS.transpose(2, 1, 0))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert ct(tmp_path).segmentations() == ()
    assert "labels.nii.gz: the file is cut short" in " ".join(ct(tmp_path).report().problems)
    path.write_bytes(gzip.compress(gzip.decompress(whole)[:-3]))
    assert "3 bytes are missing" in " ".join(ct(tmp_path).report().problems)
    path.unlink()
    write_nifti(tmp_path / "image.nii", T, LABELS.transpose(2, 1, 0).astype(np.float32))
    assert "its voxels are not whole numbers" in " ".join(ct(tmp_path).report().problems)


def test_an_empty_segment_is_refused(tmp_path: Path) -> None:
    write_series(tmp_path, change=hospital)
    write_seg(tmp_path, pixel_array=np.where(LABELS == 1, 1, 0).astype(np.uint8))
    with pytest.raises(UnreadableFileError, match="the segments spheres are empty"):
        read(tmp_path, "spheres")


def test_each_qform_of_nibabel_is_understood(tmp_path: Path) -> None:
    for number, signs in enumerate(itertools.product((1, -1), repeat=3)):
        folder = tmp_path / str(number)
        T = write_series(folder, rotation=OBLIQUE)
        flip = np.diag([*signs, 1.0])
        flip[:3, 3] = [0 if sign > 0 else n - 1 for sign, n in zip(signs, SHAPE[::-1], strict=True)]
        path = tmp_path / f"{number}.nii"
        write_nifti(path, T @ flip, LABELS.transpose(2, 1, 0)[tuple(slice(None, None, sign) for sign in signs)])
        image: Any = nibabel.load(path)
        image.set_qform(image.affine, code=1)
        image.set_sform(None, code=0)
        nibabel.save(image, folder / "labels.nii")
        np.testing.assert_array_equal(read(folder).inside, LABELS > 0)
