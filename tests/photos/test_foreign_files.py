"""Files made by others: meshes and photographs shipped with packages."""

from __future__ import annotations

import shutil
from importlib.metadata import files
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import IncompleteExportError, UnreadableFileError
from drivers.meshes.mesh_file import read_mesh_file
from drivers.photos.photo_file import read_exif
from service.compute.images.photographs import read_image


def shipped(package: str, name: str) -> Path:
    """A file of an installed package."""
    found = [Path(str(file.locate())) for file in files(package) or [] if file.name == name]
    assert found, f"{package} no longer ships {name}"
    return found[0]


def test_the_stanford_bunny_is_read() -> None:
    scan = read_mesh_file(shipped("pymeshfix", "StanfordBunny.ply"), "mm")
    assert len(scan.mesh.faces) > 30_000
    assert np.allclose(np.ptp(scan.mesh.vertices_m, axis=0), [0.0500, 0.0387, 0.0494], atol=1e-4)
    assert scan.findings["holes"] > 0  # the well-known scan is open at its base
    assert np.allclose(np.linalg.norm(scan.mesh.normals, axis=1), 1.0, atol=1e-6)


def test_a_flat_mesh_is_read() -> None:
    scan = read_mesh_file(shipped("pymeshfix", "planar_mesh.ply"), "mm")
    assert len(scan.mesh.faces) > 100
    assert scan.findings["boundary_edges"] > 0


def test_a_unit_that_cannot_be_true_is_refused() -> None:
    with pytest.raises(UnreadableFileError, match="contradicts the size"):
        read_mesh_file(shipped("pymeshfix", "StanfordBunny.ply"), "m")


def test_an_obj_without_its_materials_is_incomplete(tmp_path: Path) -> None:
    monkey = shipped("kivy-examples", "monkey.obj")
    with pytest.raises(IncompleteExportError, match=r"monkey\.mtl"):
        read_mesh_file(monkey, "m")
    copy = Path(shutil.copy(monkey, tmp_path))
    (tmp_path / "monkey.mtl").write_text("newmtl Material\nKd 0.6 0.6 0.6\n")
    # It parses and is 3.7 units across: metres are plausible, as for a room; nobody scans a head of 4 mm.
    with pytest.raises(UnreadableFileError, match=r"0\.003674 m"):
        read_mesh_file(copy, "mm")
    vertices_m = read_mesh_file(copy, "m").mesh.vertices_m
    assert np.linalg.norm(np.ptp(vertices_m, axis=0)) == pytest.approx(3.674, abs=1e-3)
    assert monkey.read_bytes() == copy.read_bytes()


def test_a_telephones_photograph_says_how_it_was_taken() -> None:
    photograph = shipped("kivy-examples", "faust_github.jpg")
    exif = read_exif(photograph)
    assert (exif.make.strip(), exif.model.strip()) == ("Motorola", "Milestone")
    assert (exif.aperture_f, exif.exposure_s, exif.iso) == (2.8, 0.05, 60)
    assert read_image(photograph).shape == (exif.height, exif.width, 3) == (598, 800, 3)
    settings = exif.settings(focus_mode="Manual", image_quality="JPEG")
    assert settings.iso == 60


def test_a_photograph_without_iso_is_refused_as_evidence_of_its_settings() -> None:
    exif = read_exif(shipped("kivy-examples", "Wall.jpg"))
    assert (exif.aperture_f, exif.exposure_s, exif.iso) == (3.5, 0.001, None)
    with pytest.raises(UnreadableFileError, match="aperture, exposure time and ISO"):
        exif.settings(focus_mode="Manual", image_quality="JPEG")


@pytest.mark.parametrize("name", ["kiwi.jpg", "Bubbles.jpg", "Ill1.jpg", "kivy.jpg", "tex3.jpg"])
def test_pictures_without_exif_are_pictures_all_the_same(name: str) -> None:
    picture = shipped("kivy-examples", name)
    exif = read_exif(picture)
    assert exif.make == ""
    assert exif.iso is None
    assert read_image(picture).shape == (exif.height, exif.width, 3)
