"""An export appears when it is whole, goes on after an interruption, and never overwrites anything."""

from __future__ import annotations

import dataclasses
import multiprocessing
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.images.photographs import read_image_of
from service.compute.images.render import hull_mask
from service.core.errors import ConfigurationError, DataError
from service.dataset.export_folder import ExportFolder, export_folder
from service.dataset.exporter import exporter, exporters, write_data_set
from service.dataset.pixels import PixelsOfAnother, cropped_data_set, undistorted_data_set
from service.dataset.records import DataSet, Pixels, PosedView
from tests.support.scenes.posed import posed_data_set, scene


class PowerCutError(Exception):
    """Ends an export in the middle."""


class CutAfter(PixelsOfAnother):
    """Pixels that can be read so often, and no more."""

    def __init__(self, inner: Pixels, reads: int) -> None:
        super().__init__(inner)
        self.left, self.read = reads, list[str]()

    def picture(self, view: PosedView) -> bytes:
        if self.left == 0:
            raise PowerCutError
        self.left -= 1
        self.read.append(view.name)
        return super().picture(view)


@pytest.fixture
def dataset(tmp_path: Path) -> DataSet:
    (tmp_path / "photographs").mkdir()
    return posed_data_set(tmp_path / "photographs")


def contents(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("reads", [0, 1, 3])
def test_an_interrupted_export_goes_on_and_ends_as_if_nothing_had_been(
    dataset: DataSet, tmp_path: Path, reads: int
) -> None:
    how, target = exporter("colmap"), tmp_path / "out"
    cut = CutAfter(dataset.pixels, reads)
    with pytest.raises(PowerCutError):
        write_data_set(dataclasses.replace(dataset, pixels=cut), how, target)
    assert not target.exists()
    going_on = CutAfter(dataset.pixels, 99)
    write_data_set(dataclasses.replace(dataset, pixels=going_on), how, target)
    assert going_on.read == [view.name for view in dataset.views][reads:]
    write_data_set(dataset, how, tmp_path / "at_once")
    assert contents(target) == contents(tmp_path / "at_once")
    assert {path.name for path in tmp_path.iterdir()} == {"photographs", "out", "at_once"}


def test_another_export_to_the_same_place_begins_anew(dataset: DataSet, tmp_path: Path) -> None:
    how, target = exporter("colmap"), tmp_path / "out"
    with pytest.raises(PowerCutError):
        write_data_set(dataclasses.replace(dataset, pixels=CutAfter(dataset.pixels, 2)), how, target)
    other = dataclasses.replace(dataset, identity="another run", pixels=CutAfter(dataset.pixels, 99))
    write_data_set(other, how, target)
    assert isinstance(other.pixels, CutAfter)
    assert len(other.pixels.read) == len(dataset.views)


def test_a_file_half_written_is_never_taken_for_whole(tmp_path: Path) -> None:
    def half(part: Path) -> None:
        part.write_bytes(b"half")
        raise PowerCutError

    with pytest.raises(PowerCutError), export_folder(tmp_path / "out", "x") as folder:
        folder.written_by("big.bin", half)
    with export_folder(tmp_path / "out", "x") as folder:
        folder.file("big.bin", lambda: b"whole")
    assert contents(tmp_path / "out").keys() == {"big.bin", "SHA256SUMS"}
    assert (tmp_path / "out" / "big.bin").read_bytes() == b"whole"


def test_nothing_is_overwritten(dataset: DataSet, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with pytest.raises(DataError, match="exists already"):
        write_data_set(dataset, exporter("gltf"), tmp_path / "out")
    (tmp_path / ".other.part").mkdir()
    (tmp_path / ".other.part" / "precious").write_text("mine")
    with pytest.raises(DataError, match="not an export"):
        write_data_set(dataset, exporter("gltf"), tmp_path / "other")
    assert (tmp_path / ".other.part" / "precious").read_text() == "mine"
    with pytest.raises(DataError, match="cannot be made"):
        write_data_set(dataset, exporter("gltf"), tmp_path / "missing" / "out")


def _try(target: Path) -> str:
    try:
        with export_folder(target, "x"):
            return "wrote"
    except ConfigurationError as error:
        return error.what


@pytest.mark.slow
def test_two_processes_do_not_write_one_export(tmp_path: Path) -> None:
    with export_folder(tmp_path / "out", "x") as folder:
        folder.text("a.txt", "a")
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            assert pool.apply(_try, (tmp_path / "out",)) == "another process is writing this export"
    assert (tmp_path / "out" / "a.txt").read_text() == "a"


@pytest.mark.parametrize("name", ["../outside.txt", "twice.txt"])
def test_a_file_is_written_once_and_inside(tmp_path: Path, name: str) -> None:
    def write(folder: ExportFolder) -> None:
        folder.text("twice.txt", "once")
        folder.text(name, "again")

    with pytest.raises(ConfigurationError), export_folder(tmp_path / "out", "x") as folder:
        write(folder)
    assert not (tmp_path / "outside.txt").exists()


def test_an_unknown_format_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigurationError, match="colmap-binary"):
        exporter("nonsense")


# --- crops ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("straight", [False, True])
def test_crops_show_the_specimen_without_markers_and_keep_their_geometry(dataset: DataSet, straight: bool) -> None:
    whole = undistorted_data_set(dataset) if straight else dataset
    spheres = np.array([sphere.centre_m for sphere in scene().spheres])
    crops = cropped_data_set(whole, lambda v: hull_mask(v.camera, v.T_world_camera, spheres), (64, 48))
    assert {view.name for view in crops.views} == {f"{view.name}_crop0" for view in dataset.views}
    assert set(crops.splits.dense) == {view.name for view in crops.views}
    for view in crops.views:
        assert not crops.pixels.markers(view).any()
        assert crops.pixels.valid(view).all()
        colours, depth = crops.pixels.colours(view), crops.pixels.depth_m(view)
        assert colours.shape == (48, 64, 3)
        assert np.count_nonzero(depth) > 0.2 * depth.size
        # Colour, depth, camera and pose still belong together.
        v, u = (k.ravel() for k in np.mgrid[2:46:3, 2:62:3])
        z = depth[v, u].astype(np.float64)
        xy = view.camera.normalise(np.stack([u, v], 1).astype(np.float64))
        points = np.column_stack([xy * z[:, None], z]) @ view.T_world_camera[:3, :3].T + view.T_world_camera[:3, 3]
        error = colours[v, u, 0].astype(np.float64) - scene().tone(points)
        assert np.median(np.abs(error)[z > 0]) < 2.0


@pytest.mark.parametrize("straight", [False, True])
def test_an_image_is_decoded_once_for_all_its_crops(
    dataset: DataSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, straight: bool
) -> None:
    decoded: list[Path] = []

    def counted(path: Path, camera: CameraModel) -> NDArray[np.uint8]:
        decoded.append(path)
        return read_image_of(path, camera)

    monkeypatch.setattr("service.dataset.pixels.read_image_of", counted)
    whole = undistorted_data_set(dataset) if straight else dataset
    everywhere = cropped_data_set(
        whole, lambda view: np.ones((view.camera.height, view.camera.width), bool), (40, 30), most=4
    )
    assert len(everywhere.views) > 2 * len(dataset.views)
    write_data_set(everywhere, exporter("colmap"), tmp_path / "out")
    assert len(decoded) == len(set(decoded)) == len(dataset.views)


def test_a_data_set_without_room_for_a_crop_says_so(dataset: DataSet) -> None:
    with pytest.raises(DataError, match="without a sphere or post"):
        cropped_data_set(dataset, lambda view: np.zeros((view.camera.height, view.camera.width), bool), (64, 48))


@pytest.mark.slow
def test_progress_counts_every_file_up_to_its_total(dataset: DataSet, tmp_path: Path) -> None:
    for name in exporters():
        told: list[tuple[str, int, int]] = []
        out = tmp_path / name
        write_data_set(dataset, exporter(name), out, progress=lambda *what, told=told: told.append(what))
        written = sum(1 for path in out.rglob("*") if path.is_file() and path.name != "SHA256SUMS")
        assert told == [("writing", count, written) for count in range(1, written + 1)], name
