"""Copies of CT files that name no person: what goes, what stays, and that files still refer to each other."""

from __future__ import annotations

import gzip
import hashlib
from pathlib import Path

import nibabel
import numpy as np
import pydicom
import pytest
from nibabel.nifti1 import Nifti1Extension
from pydicom import config
from pydicom.dataset import Dataset
from pydicom.uid import UID, ExplicitVRLittleEndian, ImplicitVRLittleEndian, RLELossless, generate_uid

from drivers.dicom_folder import DicomFolderConfig
from drivers.dicom_folder.folder import DicomFolder
from drivers.errors import UnreadableFileError
from drivers.interfaces import CleanFile
from tests.support.ct.ct_labels import LABELS, write_nifti, write_seg
from tests.support.ct.ct_series import hospital, pixels, write_series

PERSONAL = b"DOE JOHN MRN-4711 19500102 ACC-12 HOUSE SMITH General 20260101 SN-99 secret nickname".split()


def secret(ds: Dataset, k: int) -> None:
    """A hospital's slice with private attributes, nested names and free text."""
    hospital(ds, k)
    ds.ImageComments, ds.SeriesDescription, ds.PatientComments = "secret", "DOE spine", "secret"
    block = ds.private_block(0x0029, "ACME 1.1", create=True)
    block.add_new(0x10, "LO", "nickname")
    nested = Dataset()
    nested.PatientName = "DOE^JOHN"
    ds.RequestAttributesSequence = [nested]


def strictly_valid(path: Path, monkeypatch: pytest.MonkeyPatch) -> Dataset:
    """A file's data set, every value of which is as long and of the form that DICOM allows."""
    with monkeypatch.context() as strict:
        strict.setattr(config.settings, "reading_validation_mode", config.RAISE)
        dataset = pydicom.dcmread(path)
        dataset.walk(lambda _parent, element: element.value)
    return dataset


def driver(folder: Path, *, deidentify: bool = True) -> DicomFolder:
    return DicomFolder(DicomFolderConfig(folder=folder, stable_s=0.0, deidentify=deidentify))


def clean_copies(folder: Path, target: Path) -> list[CleanFile]:
    target.mkdir()
    copies = [
        driver(folder).without_personal_data(path, target / f"{k}.dcm")
        for k, path in enumerate(sorted(folder.iterdir()))
    ]
    return [copy for copy in copies if copy is not None]


@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, ImplicitVRLittleEndian, RLELossless])
def test_nothing_that_names_a_person_is_left_and_every_pixel_is(tmp_path: Path, syntax: UID) -> None:
    write_series(tmp_path / "ct", change=secret, syntax=syntax)
    originals = {path: path.read_bytes() for path in sorted((tmp_path / "ct").iterdir())}
    assert all(word in next(iter(originals.values())) for word in PERSONAL)
    copies = clean_copies(tmp_path / "ct", tmp_path / "clean")
    for copy, (path, data) in zip(copies, originals.items(), strict=True):
        written = copy.path.read_bytes()
        assert [word for word in PERSONAL if word in written] == []
        assert copy.original_sha256 == hashlib.sha256(data).hexdigest()
        assert path.read_bytes() == data
        assert pydicom.dcmread(copy.path).PixelData == pydicom.dcmread(path).PixelData
    before, after = (driver(tmp_path / name) for name in ("ct", "clean"))
    (old,), (new,) = before.series(), after.series()
    assert new.problems == ()
    was, now = before.read(old), after.read(new)
    np.testing.assert_array_equal(now.hounsfield, was.hounsfield)
    np.testing.assert_array_equal(now.hounsfield, 2 * pixels() - 1000)
    np.testing.assert_array_equal(now.T_ct_voxel, was.T_ct_voxel)


def test_the_attributes_are_named_without_their_values(tmp_path: Path) -> None:
    write_series(tmp_path / "ct", change=secret)
    removed = set(clean_copies(tmp_path / "ct", tmp_path / "clean")[0].removed)
    assert {"PatientName", "PatientID", "PatientBirthDate", "InstitutionName", "AcquisitionDate"} <= removed
    assert {"RequestAttributesSequence", "private (0029,0010)", "private (0029,1010)", "ImageComments"} <= removed
    assert not {"PixelSpacing", "ImagePositionPatient", "KVP", "PixelData", "SOPInstanceUID"} & removed
    assert not [word for word in PERSONAL if word.decode() in " ".join(removed)]
    copy = pydicom.dcmread(tmp_path / "clean" / "0.dcm")
    assert (str(copy.PatientName), copy.PatientID, copy.PatientIdentityRemoved) == ("", "", "YES")
    assert copy.KVP == 120


def test_uids_are_replaced_so_that_files_still_refer_to_each_other(tmp_path: Path) -> None:
    write_series(tmp_path / "ct", change=secret)
    write_seg(tmp_path / "ct")
    before = [pydicom.dcmread(path) for path in sorted((tmp_path / "ct").iterdir())]
    clean_copies(tmp_path / "ct", tmp_path / "clean")
    after = [pydicom.dcmread(tmp_path / "clean" / f"{k}.dcm") for k in range(len(before))]
    names = ("SOPInstanceUID", "SeriesInstanceUID", "FrameOfReferenceUID", "StudyInstanceUID")
    uids = [{str(ds[name].value) for ds in found for name in names} for found in (before, after)]
    assert uids[0].isdisjoint(uids[1])
    assert len(uids[0]) == len(uids[1])
    assert all(uid.startswith("2.25.") for uid in uids[1])
    assert all(ds.file_meta.MediaStorageSOPInstanceUID == ds.SOPInstanceUID for ds in after)
    # The segmentation is still one of this series, to our reader and by its references.
    folder = driver(tmp_path / "clean")
    (series,), (found,) = folder.series(), folder.segmentations()
    labels = folder.read_labels(found, folder.read(series), ())
    np.testing.assert_array_equal(labels.inside, LABELS > 0)
    instances = {ds.SOPInstanceUID for ds in after}
    referred = after[-1].ReferencedSeriesSequence[0].ReferencedInstanceSequence
    assert {item.ReferencedSOPInstanceUID for item in referred} <= instances
    # A second copy gets the same UIDs.
    again = [pydicom.dcmread(copy.path).SOPInstanceUID for copy in clean_copies(tmp_path / "ct", tmp_path / "again")]
    assert again == [ds.SOPInstanceUID for ds in after]


def test_text_burned_into_the_pixels_is_refused(tmp_path: Path) -> None:
    def burned(ds: Dataset, k: int) -> None:
        ds.BurnedInAnnotation = "YES"

    write_series(tmp_path / "ct", change=burned)
    with pytest.raises(UnreadableFileError, match="text is burned into its pixels"):
        clean_copies(tmp_path / "ct", tmp_path / "clean")


def test_a_rig_may_keep_the_files_as_they_are(tmp_path: Path) -> None:
    write_series(tmp_path, change=secret)
    kept = driver(tmp_path, deidentify=False).without_personal_data(tmp_path / "I0000", tmp_path / "copy.dcm")
    assert kept is None
    assert not (tmp_path / "copy.dcm").exists()


@pytest.mark.parametrize("name", ["labels.nii", "labels.nii.gz"])
def test_the_texts_of_a_nifti_file_go_and_its_voxels_stay(tmp_path: Path, name: str) -> None:
    T = write_series(tmp_path / "ct")
    path = tmp_path / "ct" / name
    write_nifti(path, T, LABELS.transpose(2, 1, 0), descrip="DOE spine", intent_name="secret", aux_file="nickname")
    image = nibabel.load(path)
    assert isinstance(image, nibabel.Nifti1Image)
    image = nibabel.Nifti1Image(np.asarray(image.dataobj).copy(), image.affine, image.header)
    image.header.extensions.append(Nifti1Extension("comment", b"DOE^JOHN"))
    nibabel.save(image, path)
    (tmp_path / "clean").mkdir()
    copy = driver(tmp_path / "ct").without_personal_data(path, tmp_path / "clean" / name)
    assert copy is not None
    assert copy.removed == ("NIfTI aux_file", "NIfTI descrip", "NIfTI extensions", "NIfTI intent_name")
    data = copy.path.read_bytes()
    data = gzip.decompress(data) if name.endswith(".gz") else data
    assert [word for word in PERSONAL if word in data] == []
    again = nibabel.load(copy.path)
    assert isinstance(again, nibabel.Nifti1Image)
    np.testing.assert_array_equal(np.asarray(again.dataobj), LABELS.transpose(2, 1, 0))
    np.testing.assert_array_equal(again.affine, image.affine)


def test_a_slice_without_a_header_of_its_own_is_copied_too(tmp_path: Path) -> None:
    write_series(tmp_path / "ct", change=secret, syntax=ImplicitVRLittleEndian)
    path = tmp_path / "ct" / "I0002"
    ds = pydicom.dcmread(path)
    ds.SOPInstanceUID = generate_uid()
    del ds.file_meta
    ds.preamble = None
    ds.save_as(path, implicit_vr=True, little_endian=True, enforce_file_format=False)
    copies = clean_copies(tmp_path / "ct", tmp_path / "clean")
    assert len(copies) == 5
    assert pydicom.dcmread(copies[2].path).PixelData == ds.PixelData


def test_a_copy_has_only_values_that_dicom_allows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_series(tmp_path / "ct", change=secret)
    first = clean_copies(tmp_path / "ct", tmp_path / "clean")[0]
    dataset = strictly_valid(first.path, monkeypatch)
    assert "UIDs replaced" in dataset.DeidentificationMethod
