"""Enhanced multi-frame CT by highdicom, and compressed slices by GDCM: other programs write, the driver reads."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import gdcm
import numpy as np
import pydicom
import pytest
from pydicom.dataset import Dataset
from pydicom.uid import RLELossless, generate_uid

from drivers.dicom_folder import DicomFolderConfig
from drivers.dicom_folder.folder import DicomFolder
from drivers.errors import UnreadableFileError
from drivers.interfaces import Array, CtSeries
from tests.support.ct.ct_series import SHAPE, enhanced_of, hospital, pixels, write_series
from tests.support.rig.rig import REPOSITORY

SYNTAXES = {
    "RLE": gdcm.TransferSyntax.RLELossless,
    "JPEG Lossless": gdcm.TransferSyntax.JPEGLosslessProcess14_1,
    "JPEG-LS": gdcm.TransferSyntax.JPEGLSLossless,
    "JPEG 2000": gdcm.TransferSyntax.JPEG2000Lossless,
}


def source(folder: Path) -> DicomFolder:
    return DicomFolder(DicomFolderConfig(folder=folder, stable_s=0.0))


def only(folder: Path) -> CtSeries:
    (series,) = source(folder).series()
    return series


def enhance(slices: Path, target: Path) -> Array:
    """Write a series of single slices to `slices`, and the same as one enhanced file; returns T_ct_voxel."""
    T = write_series(slices, change=hospital)
    target.mkdir()
    enhanced_of(slices, generate_uid()).save_as(target / "enhanced.dcm")
    return T


@pytest.mark.slow
def test_an_enhanced_file_is_read_as_its_slices_are(tmp_path: Path) -> None:
    T = enhance(tmp_path / "slices", tmp_path / "enhanced")
    series = only(tmp_path / "enhanced")
    assert (series.slices, len(series.files), series.problems) == (SHAPE[0], 1, ())
    volume = source(tmp_path / "enhanced").read(series)
    np.testing.assert_allclose(volume.T_ct_voxel, T, atol=1e-9)
    np.testing.assert_array_equal(volume.hounsfield, 2 * pixels() - 1000)


def localiser(frame: Dataset) -> None:
    kind = Dataset()
    kind.FrameType = ["ORIGINAL", "PRIMARY", "LOCALIZER", "NONE"]
    frame.CTImageFrameTypeSequence = [kind]


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda frame: frame.PlanePositionSequence.clear(), "no position, orientation or pixel spacing in"),
        (localiser, "localiser images"),
    ],
)
def test_a_frame_that_spoils_the_volume_is_named(
    tmp_path: Path, spoil: Callable[[Dataset], None], words: str
) -> None:
    enhance(tmp_path / "slices", tmp_path / "enhanced")
    path = tmp_path / "enhanced" / "enhanced.dcm"
    ds = pydicom.dcmread(path)
    spoil(ds.PerFrameFunctionalGroupsSequence[2])
    ds.save_as(path)
    assert f"{words}: enhanced.dcm frame 3" in " ".join(only(tmp_path / "enhanced").problems)


def test_fewer_described_frames_than_stated_are_a_damaged_file(tmp_path: Path) -> None:
    enhance(tmp_path / "slices", tmp_path / "enhanced")
    path = tmp_path / "enhanced" / "enhanced.dcm"
    ds = pydicom.dcmread(path)
    ds.PerFrameFunctionalGroupsSequence.pop()
    ds.save_as(path)
    ct = source(tmp_path / "enhanced")
    assert ct.series() == ()
    assert "states 5 frames and describes 4" in " ".join(ct.report().problems)


def compress(folder: Path, syntax: int) -> None:
    """Let GDCM compress every file of a folder in place."""
    for path in folder.iterdir():
        reader = gdcm.ImageReader()
        reader.SetFileName(str(path))
        assert reader.Read()
        change = gdcm.ImageChangeTransferSyntax()
        change.SetTransferSyntax(gdcm.TransferSyntax(syntax))
        change.SetInput(reader.GetImage())
        assert change.Change()
        writer = gdcm.ImageWriter()
        writer.SetFile(reader.GetFile())
        writer.SetImage(change.GetOutput())
        writer.SetFileName(str(path))
        assert writer.Write()


def in_hounsfield_units(ds: Dataset, _k: int) -> None:
    """GDCM states that the unit is unspecified where the file states none."""
    ds.RescaleType = "HU"


@pytest.mark.parametrize("name", SYNTAXES)
def test_what_gdcm_compressed_without_loss_reads_as_it_was(tmp_path: Path, name: str) -> None:
    write_series(tmp_path, change=in_hounsfield_units)
    compress(tmp_path, SYNTAXES[name])
    series = only(tmp_path)
    assert series.problems == ()
    np.testing.assert_array_equal(source(tmp_path).read(series).hounsfield, 2 * pixels() - 1000)


def test_an_enhanced_file_in_rle_reads_frame_by_frame(tmp_path: Path) -> None:
    enhance(tmp_path / "slices", tmp_path / "enhanced")
    path = tmp_path / "enhanced" / "enhanced.dcm"
    ds = pydicom.dcmread(path)
    ds.compress(RLELossless)
    ds.save_as(path)
    series = only(tmp_path / "enhanced")
    np.testing.assert_array_equal(source(tmp_path / "enhanced").read(series).hounsfield, 2 * pixels() - 1000)


@pytest.mark.parametrize(
    ("name", "install"),
    [("JPEG Lossless", "pip install python-gdcm"), ("JPEG-LS", "pip install python-gdcm, or pyjpegls")],
)
def test_a_missing_decoder_is_named_with_what_to_install(tmp_path: Path, name: str, install: str) -> None:
    write_series(tmp_path)
    compress(tmp_path, SYNTAXES[name])
    # As on a computer without the optional packages: in a process of its own, which cannot import them.
    program = (
        "import sys\n"
        "for package in ('gdcm', 'pylibjpeg', 'jpeg_ls'): sys.modules[package] = None\n"
        "from pathlib import Path\n"
        "from drivers.dicom_folder import DicomFolderConfig\n"
        "from drivers.dicom_folder.folder import DicomFolder\n"
        "ct = DicomFolder(DicomFolderConfig(folder=Path(sys.argv[1]), stable_s=0))\n"
        "print(*ct.series()[0].problems)\n"
    )
    told = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path)], check=True, capture_output=True, text=True, cwd=REPOSITORY
    ).stdout
    assert f"compressed as {name}" in told
    assert f"no decoder is installed ({install})" in told
    assert "I0000" in told


def test_a_compressed_slice_that_is_cut_short_is_named(tmp_path: Path) -> None:
    write_series(tmp_path)
    compress(tmp_path, SYNTAXES["JPEG-LS"])
    victim = tmp_path / "I0003"
    victim.write_bytes(victim.read_bytes()[:-40])
    with pytest.raises(UnreadableFileError, match=r"I0003|cannot be decoded"):
        source(tmp_path).read(only(tmp_path))
