"""Fuzz targets for files that devices deliver: photographs, scans, point clouds, CT slices, image features."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from drivers.dicom_folder import DicomFolderConfig
from drivers.dicom_folder.folder import DicomFolder
from drivers.meshes.mesh_file import read_mesh_file
from drivers.meshes.point_cloud import is_point_cloud, read_point_cloud
from drivers.photos.photo_file import check_jpeg_complete, read_exif, taken_utc_s
from service.compute.images.photographs import read_grey, read_image
from service.compute.sfm.features import ImageFeatures, PairMatches, pack_matches, unpack_matches
from service.import_folder import camera_record
from service.store.events import canonical
from service.web.images import reduced_jpeg
from simulators.ct_suite.suite import write_series
from simulators.ct_suite.volume import Grid
from simulators.faults import FaultPlan
from simulators.rendering.sensor import bordered, read_out
from simulators.scan_station.formats import encode
from simulators.sony_camera.exif import PLATE
from simulators.still_camera.exif import ExposureSettings, Shot, encode_jpeg
from simulators.still_camera.raw_file import encode_raw
from tests.support.torture.fuzz.mutations import BYTES, TEXT
from tests.support.torture.fuzz.targets.target import MisbehavedError, Target

SLICES, ROWS = 3, 6
_SETTINGS = ExposureSettings(22.0, 1 / 50, (1, 50), 100)


def _put(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


# --- photographs --------------------------------------------------------------------------------------------------


def _shot() -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.uint8]], Shot]:
    picture = np.random.default_rng(5).integers(0, 255, (32, 48, 3), dtype=np.uint8)
    return picture, Shot(_SETTINGS, 7, datetime(2026, 11, 22, 10, 0, 0, 120_000, tzinfo=UTC), PLATE)


def _jpegs(_: Path) -> list[bytes]:
    return [encode_jpeg(*_shot())]


def _photographs(_: Path) -> list[bytes]:
    picture, shot = _shot()
    return [encode_jpeg(picture, shot), encode_raw(read_out(bordered(picture), 100, 7), shot)]


def _pictures(_: Path) -> list[bytes]:
    import cv2  # noqa: PLC0415 - only this needs its encoders

    picture = _shot()[0]
    others = [cv2.imencode(suffix, picture)[1].tobytes() for suffix in (".png", ".tiff")]
    return [encode_jpeg(*_shot()), *others]


def _exif(data: bytes, folder: Path) -> None:
    path = _put(folder, "DSC00007.ARW" if data.startswith(b"II*") else "DSC00007.JPG", data)
    record = read_exif(path)
    canonical(camera_record(record))  # as an import records it
    taken_utc_s(record.taken)
    record.settings(focus_mode=record.focus_mode, image_quality="JPEG")


def _image(data: bytes, folder: Path) -> None:
    path = _put(folder, "image.jpg" if data.startswith(b"\xff\xd8") else "image.png", data)
    if read_image(path).shape[:2] != read_grey(path).shape:
        raise MisbehavedError("colours and brightness of one file differ in size")


def _web_picture(data: bytes, folder: Path) -> None:
    reduced_jpeg(_put(folder, "picture", data), 40)


# --- scans --------------------------------------------------------------------------------------------------------


def _ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=1, radius=150.0)


def _scan(kind: str) -> list[bytes]:
    ball = _ball()
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    normals = np.asarray(ball.vertex_normals)
    return [encode(kind, f"scan.{kind}", vertices, faces, with_normals)[0][1] for with_normals in (normals, None)]


def _obj_parts() -> list[tuple[str, bytes]]:
    ball = _ball()
    return encode("obj", "scan.obj", np.asarray(ball.vertices), np.asarray(ball.faces), None)


def _exported(shape: Any, kind: str, **options: Any) -> bytes:
    """Export with trimesh, whose files differ from those of the simulated scanner."""
    written = shape.export(file_type=kind, **options)
    return written.encode() if isinstance(written, str) else bytes(written)


def _plys(_: Path) -> list[bytes]:
    return [*_scan("ply"), _exported(_ball(), "ply", encoding="ascii")]


def _stls(_: Path) -> list[bytes]:
    return [_scan("stl")[0], _exported(_ball(), "stl_ascii")]


def _mesh(kind: str) -> Callable[[bytes, Path], None]:
    def parse(data: bytes, folder: Path) -> None:
        if kind == "obj":
            for name, content in _obj_parts()[1:]:
                _put(folder, name, content)
        scan = read_mesh_file(_put(folder, f"scan.{kind}", data))
        if not (np.isfinite(scan.mesh.vertices_m).all() and np.isfinite(scan.mesh.normals).all()):
            raise MisbehavedError("a mesh that is not finite is accepted")

    return parse


def _material(data: bytes, folder: Path) -> None:
    (name, mesh), (material, _), (texture, picture) = _obj_parts()
    for file, content in ((name, mesh), (material, data), (texture, picture)):
        _put(folder, file, content)
    read_mesh_file(folder / name)


def _clouds(_: Path) -> list[bytes]:
    ball = _ball()
    points = np.column_stack([ball.vertices, ball.vertex_normals])
    text = io.StringIO()
    np.savetxt(text, points, fmt="%.5f")
    return [text.getvalue().encode(), text.getvalue().replace(" ", ",").encode()]


def _cloud_plys(_: Path) -> list[bytes]:
    cloud = trimesh.PointCloud(_ball().vertices)
    return [_exported(cloud, "ply"), *_scan("ply")]


def _cloud(suffix: str) -> Callable[[bytes, Path], None]:
    def parse(data: bytes, folder: Path) -> None:
        path = _put(folder, f"points{suffix}", data)
        if is_point_cloud(path):
            read_point_cloud(path)

    return parse


# --- CT -----------------------------------------------------------------------------------------------------------


def write_slices(folder: Path, *, implicit: bool = False) -> None:
    """Write a series of SLICES slices of ROWS × ROWS voxels of 1 mm."""
    volume = np.random.default_rng(3).integers(-1000, 1000, (SLICES, ROWS, ROWS)).astype(np.int16)
    grid = Grid(np.eye(4), 1e-3, (SLICES, ROWS, ROWS))
    write_series(folder, volume, grid, np.eye(4), "1.2.3.4", implicit=implicit, faults=FaultPlan())


def _slices(folder: Path) -> list[bytes]:
    found: list[bytes] = []
    for implicit in (False, True):
        part = folder / str(implicit)
        part.mkdir()
        write_slices(part, implicit=implicit)
        found += [path.read_bytes() for path in sorted(part.iterdir())][1:2]
    return found


_WHOLE: dict[str, Path] = {}


def _series(data: bytes, folder: Path) -> None:
    """Read three slices, of which the middle one is the input."""
    whole = _WHOLE.get("series")
    if whole is None or not whole.exists():
        whole = _WHOLE["series"] = folder.parent / "series"
        whole.mkdir()
        write_slices(whole)
    shutil.copytree(whole, folder / "ct")
    sorted((folder / "ct").iterdir())[1].write_bytes(data)
    source = DicomFolder(DicomFolderConfig(folder=folder / "ct", stable_s=0))
    source.open()
    source.report()
    for series in source.series():
        if not series.problems:
            source.read(series)


def _features(_: Path) -> list[bytes]:
    rng = np.random.default_rng(2)
    pixels = rng.uniform(0, 100, (20, 2)).astype(np.float32)
    descriptors = rng.integers(0, 255, (20, 128), dtype=np.uint8)
    return [ImageFeatures(480, 320, pixels, np.ones(20, np.float32), descriptors).to_bytes()]


def _matches(_: Path) -> list[bytes]:
    pairs = np.array([[0, 1], [2, 3]], dtype=np.uint32)
    return [pack_matches([PairMatches("a.jpg", "b.jpg", pairs, 2, np.zeros((3, 3, 3)))])]


TARGETS: tuple[Target, ...] = (
    Target("photo_exif", "drivers.photos.photo_file:read_exif", _exif, _photographs, pace=2.0),
    Target(
        "photo_jpeg",
        "drivers.photos.photo_file:check_jpeg_complete",
        lambda data, folder: check_jpeg_complete(_put(folder, "DSC00007.JPG", data)),
        _jpegs,
    ),
    Target("image", "service.compute.images.photographs:read_image", _image, _pictures, memory_mib=1536, pace=2.0),
    Target("web_picture", "service.web.images:reduced_jpeg", _web_picture, _pictures, memory_mib=1024),
    Target("mesh_ply", "drivers.meshes.mesh_file:read_mesh_file", _mesh("ply"), _plys, (*BYTES, *TEXT)),
    Target("mesh_stl", "drivers.meshes.mesh_file:read_mesh_file", _mesh("stl"), _stls, (*BYTES, *TEXT)),
    Target("mesh_obj", "drivers.meshes.mesh_file:read_mesh_file", _mesh("obj"), lambda _: _scan("obj"), TEXT),
    Target(
        "mesh_material",
        "drivers.meshes.companions:companions",
        _material,
        lambda _: [_obj_parts()[1][1]],
        TEXT,
        pace=0.5,
    ),
    Target("cloud_text", "drivers.meshes.point_cloud:read_point_cloud", _cloud(".xyz"), _clouds, TEXT),
    Target("cloud_ply", "drivers.meshes.point_cloud:read_point_cloud", _cloud(".ply"), _cloud_plys, (*BYTES, *TEXT)),
    Target("dicom", "drivers.dicom_folder.folder:DicomFolder", _series, _slices, (*BYTES, *TEXT), pace=0.5),
    Target(
        "image_features",
        "service.compute.sfm.features:ImageFeatures.from_bytes",
        lambda data, _: ImageFeatures.from_bytes(data),
        _features,
        says_place=False,
    ),
    Target(
        "image_matches",
        "service.compute.sfm.features:unpack_matches",
        lambda data, _: unpack_matches(data),
        _matches,
        says_place=False,
    ),
)
