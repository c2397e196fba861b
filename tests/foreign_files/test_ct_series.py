"""CT series that other programs write: one thing, in Hounsfield units, or refused with what differs and where.

Values are derived by hand from the stored pixels: HU = 2 × stored - 1000 (tests/support/ct/ct_series.py). GDCM 3.2.6
gives the same.
"""

from __future__ import annotations

from pathlib import Path

import gdcm
import numpy as np
import pytest
from pydicom.dataset import Dataset
from pydicom.uid import generate_uid
from typer.testing import CliRunner

from drivers.dicom_folder import DicomFolderConfig
from drivers.dicom_folder.folder import DicomFolder
from drivers.errors import UnreadableFileError
from drivers.interfaces import Array
from service.cli.main import app
from tests.support.ct.ct_series import SHAPE, Change, enhanced_of, hospital, pixels, write_series


def _source(folder: Path, *, unspecified_is_hounsfield: bool = False) -> DicomFolder:
    return DicomFolder(
        DicomFolderConfig(folder=folder, stable_s=0.0, unspecified_is_hounsfield=unspecified_is_hounsfield)
    )


def _from_slice(k_from: int, **changed: object) -> Change:
    def change(ds: Dataset, k: int) -> None:
        hospital(ds, k)
        ds.RescaleType, ds.ConvolutionKernel, ds.PatientPosition = "HU", ["Br60f", "3"], "HFS"
        if k >= k_from:
            for name, value in changed.items():
                setattr(ds, name, value)

    return change


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"FrameOfReferenceUID": "1.2.3.4"}, "mixed frame of reference"),
        ({"StudyInstanceUID": "1.2.3.4"}, "mixed study"),
        ({"PatientID": "MRN-4712"}, "mixed patient"),
        ({"PatientName": "ROE^JANE"}, "mixed patient"),
        ({"Modality": "PT"}, "mixed modality"),
        ({"SeriesNumber": 2}, "mixed series number"),
        ({"PatientPosition": "FFS"}, "mixed patient position"),
        ({"DeviceSerialNumber": "SN-100"}, "mixed equipment"),
        ({"Manufacturer": "N"}, "mixed equipment"),
        ({"ConvolutionKernel": ["Br40f", "3"]}, "mixed reconstruction kernel"),
        ({"KVP": 80}, "mixed tube voltage"),
        ({"ImageType": ["DERIVED", "SECONDARY", "AXIAL"]}, "mixed image type"),
        ({"RescaleType": "MGML"}, "mixed unit of the values"),
        ({"PixelSpacing": [0.5, 0.41]}, "mixed pixel spacing"),
        ({"Rows": 4, "Columns": 12}, "mixed image size"),
        ({"ImageOrientationPatient": [1, 0, 0, 0, 0, 1]}, "mixed orientation"),
    ],
)
def test_what_differs_in_a_series_is_named_with_its_slices(
    changed: dict[str, object], words: str, tmp_path: Path
) -> None:
    write_series(tmp_path, change=_from_slice(3, **changed))
    report = _source(tmp_path).report()
    assert report.details["usable"] == "0"
    (problem,) = [text for text in report.problems if words in text]
    assert "I0003" in problem
    assert "I0004" in problem
    assert not {"4711", "4712", "DOE", "ROE"} & set(problem.replace("-", " ").replace("^", " ").split())
    source = _source(tmp_path)
    (series,) = source.series()
    with pytest.raises(UnreadableFileError, match=words):
        source.read(series)


def test_what_one_slice_states_and_others_do_not_is_a_difference(tmp_path: Path) -> None:
    def drop(ds: Dataset, k: int) -> None:
        if k < 2:
            del ds.FrameOfReferenceUID

    write_series(tmp_path, change=drop)
    (problem,) = _source(tmp_path).series()[0].problems
    assert "; none in 2 slices (I0000, I0001)" in problem


def test_how_names_and_numbers_are_padded_is_no_difference(tmp_path: Path) -> None:
    def pad(ds: Dataset, k: int) -> None:
        hospital(ds, k)
        ds.RescaleType = "HU" if k else "hu "
        ds.KVP = "120" if k else "120.0"
        ds.PatientName = "DOE^JOHN" if k else "DOE^JOHN^^^"
        ds.SeriesTime, ds.AcquisitionNumber = f"12000{k}", k
        ds.ImageType = ["ORIGINAL", "PRIMARY", "AXIAL", f"OWN{k}"]

    write_series(tmp_path, change=pad)
    assert _source(tmp_path).series()[0].problems == ()


def test_the_doctor_tells_of_two_frames_of_reference_in_one_series(tmp_path: Path) -> None:
    """The case f10: twelve slices with even positions, the last six of another frame of reference."""
    write_series(tmp_path / "ct", change=_from_slice(3, FrameOfReferenceUID="1.2.826.0.1.3680043.8.498.999"))
    rig = tmp_path / "rig.yaml"
    rig.write_text(f"name: ct\ndevices:\n  ct: {{driver: dicom_folder, folder: {tmp_path / 'ct'}, stable_s: 0}}\n")
    words = ["doctor", "--rig", str(rig), "--data", str(tmp_path / "data")]
    told = " ".join(CliRunner().invoke(app, words, catch_exceptions=False).output.split())
    assert "mixed frame of reference, which must be the same in a whole series" in told
    assert "1.2.826.0.1.3680043.8.498.999 in 2 slices (I0003, I0004)" in told
    assert "! ct" in told


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("MGML", "mg/ml, as of an iodine map"),
        ("Z_EFF", "effective atomic numbers"),
        ("ED", "electron densities"),
        ("HU_MOD", "modified Hounsfield units"),
        ("US", "of no stated unit"),
        ("SUV", "rescale type SUV"),
    ],
)
def test_values_of_another_unit_are_not_called_hounsfield(kind: str, words: str, tmp_path: Path) -> None:
    write_series(tmp_path, change=_from_slice(0, RescaleType=kind))
    source = _source(tmp_path)
    (series,) = source.series()
    assert words in " ".join(series.problems)
    with pytest.raises(UnreadableFileError, match="not said to be Hounsfield units"):
        source.read(series)


def test_frames_of_an_enhanced_file_are_checked_as_slices_are(tmp_path: Path) -> None:
    """Written by highdicom; one frame's type and unit, and the padding, are changed as programs state them there."""
    write_series(tmp_path / "slices", change=hospital)
    (tmp_path / "enhanced").mkdir()
    enhanced = enhanced_of(tmp_path / "slices", generate_uid())
    enhanced.PixelPaddingValue = 0
    enhanced.save_as(tmp_path / "enhanced" / "a.dcm")
    source = _source(tmp_path / "enhanced")
    expected = pixels() * 2 - 1000
    expected[0, 0, 0] = -1000  # stored 0: padding, and here it would be that anyway
    np.testing.assert_array_equal(source.read(source.series()[0]).hounsfield, expected)
    groups = Dataset()
    groups.RescaleSlope, groups.RescaleIntercept, groups.RescaleType = 2, -1000, "MGML"
    enhanced.PerFrameFunctionalGroupsSequence[1].PixelValueTransformationSequence = [groups]
    enhanced.save_as(tmp_path / "enhanced" / "a.dcm")
    told = " ".join(_source(tmp_path / "enhanced").series()[0].problems)
    assert "mg/ml, as of an iodine map" in told
    assert "a.dcm frame 2" in told


@pytest.mark.parametrize("word", ["EFF_ATOMIC_NUM", "ELECTRON_DENSITY", "MAT_SPECIFIC"])
def test_a_map_of_multi_energy_ct_is_not_called_hounsfield(word: str, tmp_path: Path) -> None:
    write_series(tmp_path, change=_from_slice(0, ImageType=["DERIVED", "PRIMARY", "AXIAL", word]))
    assert word in " ".join(_source(tmp_path).series()[0].problems)


@pytest.mark.parametrize("word", ["VMI", "MAT_REMOVED", "CT_SOM5 SPI"])
def test_an_attenuation_of_multi_energy_ct_is_read(word: str, tmp_path: Path) -> None:
    write_series(tmp_path, change=_from_slice(0, ImageType=["DERIVED", "PRIMARY", "AXIAL", word]))
    assert _source(tmp_path).series()[0].problems == ()


def test_what_gdcm_copies_without_a_unit_is_read_where_the_rig_says_that_it_is_hounsfield(tmp_path: Path) -> None:
    write_series(tmp_path)
    by_gdcm: list[Array] = []
    for path in sorted(tmp_path.iterdir()):  # it states a unit where the file states none: US
        reader, writer = gdcm.ImageReader(), gdcm.ImageWriter()
        reader.SetFileName(str(path))
        assert reader.Read()
        image = reader.GetImage()
        stored = np.frombuffer(image.GetBuffer().encode("utf-8", "surrogateescape"), dtype="<u2")
        by_gdcm.append(image.GetSlope() * stored.reshape(SHAPE[1:]) + image.GetIntercept())
        writer.SetFile(reader.GetFile())
        writer.SetImage(image)
        writer.SetFileName(str(path))
        assert writer.Write()
    assert "unspecified_is_hounsfield: true" in " ".join(_source(tmp_path).series()[0].problems)
    source = _source(tmp_path, unspecified_is_hounsfield=True)
    np.testing.assert_array_equal(source.read(source.series()[0]).hounsfield, by_gdcm)


@pytest.mark.parametrize(
    ("signed", "stored", "padding", "limit"),
    [
        (False, [63536], 63536, None),  # 126,072 HU, which was clipped to +32767
        (True, [-2000], -2000, None),  # -5,000 HU: less than air stays as it is
        (True, [30000, -2000], 30000, None),
        (False, [65000, 65100, 65535], 65535, 65000),  # a range, its ends in either order
        (False, [65000, 65100, 65535], 65000, 65535),
    ],
)
@pytest.mark.parametrize("other_sign", [False, True])
def test_padding_counts_as_air(
    signed: bool, stored: list[int], padding: int, limit: int | None, other_sign: bool, tmp_path: Path
) -> None:
    body = pixels()[0].copy()

    def pad(ds: Dataset, k: int) -> None:
        if k:
            return
        body.flat[: len(stored)] = stored
        ds.PixelRepresentation = int(signed)
        ds.PixelData = body.astype("<i2" if signed else "<u2").tobytes()
        for name, value in (("PixelPaddingValue", padding), ("PixelPaddingRangeLimit", limit)):
            if value is not None:  # programs state it as signed or unsigned, whatever the pixels are
                kind = "SS" if signed != other_sign else "US"
                ds.add_new(name, kind, int(np.array(value).astype("<i2" if kind == "SS" else "<u2")))

    write_series(tmp_path, change=pad)
    source = _source(tmp_path)
    found = source.read(source.series()[0]).hounsfield
    outside = np.zeros(SHAPE, dtype=bool)
    outside[0].flat[: len(stored)] = [
        min(padding, limit or padding) <= value <= max(padding, limit or padding) for value in stored
    ]
    assert outside.any()
    assert (found[outside] <= -1000).all()
    expected = np.concatenate([body[None], pixels()[1:]]) * 2 - 1000
    np.testing.assert_array_equal(found[~outside], np.clip(expected, -32768, 32767)[~outside])


def _with_pixel(stored: int) -> Change:
    def change(ds: Dataset, k: int) -> None:
        body = pixels()[k].copy()
        if k == 1:
            body[0, 0] = stored
        ds.PixelData, ds.PixelRepresentation = body.astype("<i2" if stored < 0 else "<u2").tobytes(), int(stored < 0)

    return change


def test_values_higher_than_a_volume_can_hold_are_refused_with_slice_and_scale(tmp_path: Path) -> None:
    """They were kept as 32,767 HU, without a word."""
    write_series(tmp_path, change=_with_pixel(40000))
    source = _source(tmp_path)
    with pytest.raises(UnreadableFileError, match=r"values up to 79000 HU.*slope 2 and intercept -1000") as caught:
        source.read(source.series()[0])
    assert Path(caught.value.where).name in {path.name for path in tmp_path.iterdir()}


def test_values_lower_than_a_volume_can_hold_count_as_air(tmp_path: Path) -> None:
    write_series(tmp_path, change=_with_pixel(-20000))  # -41,000 HU: outside the reconstructed circle
    source = _source(tmp_path)
    found = source.read(source.series()[0]).hounsfield
    expected = pixels() * 2 - 1000
    expected[1, 0, 0] = -1000
    np.testing.assert_array_equal(found, expected)
