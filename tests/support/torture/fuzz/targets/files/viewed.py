"""Fuzz targets for structured scans (a sensor's views, E57), other surface files, and a video camera's recordings."""

from __future__ import annotations

import base64
import dataclasses
import functools
import io
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh

from drivers.interfaces import Array, CameraSettings, ScanExport
from drivers.meshes.surface_file import read_surface_file
from drivers.scan_profiles.profile import ScanProfile
from drivers.scan_profiles.reading import read_export
from drivers.video import VideoCamera, VideoConfig
from service.store.events import canonical
from tests.support.torture.fuzz.mutations import BYTES, JSON, TEXT
from tests.support.torture.fuzz.targets.target import MisbehavedError, Target

COLUMNS, ROWS = 8, 6
_PROFILE = ScanProfile("a scanner", "its program", {".ply": "mm", ".e57": "m"}, "Export it again", ((COLUMNS, ROWS),))
_PAGE = 1024  # of an E57 file, the last four bytes of which are the checksum of the others
_SET = CameraSettings(4.0, 0.01, 100)


def _put(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


# --- views --------------------------------------------------------------------------------------------------------


def _seen_mm() -> Array:
    """Points (rows, columns, 3) of a tilted board before a sensor, some of which were not measured."""
    u, v = np.meshgrid(np.linspace(-0.3, 0.3, COLUMNS), np.linspace(-0.2, 0.2, ROWS))
    points = np.stack([u, v, np.ones_like(u)], axis=-1) * (600 + 40 * u)[..., None]
    points[0, :2] = np.nan
    return points


def _view_plys(_: Path) -> list[bytes]:
    points = _seen_mm().reshape(-1, 3)
    head = f"ply\nformat FORMAT 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz")) + "end_header\n"
    rows = np.hstack([points, np.tile([0.0, 0.0, -1.0], (len(points), 1))]).astype("<f4")
    text = io.StringIO()
    np.savetxt(text, rows, fmt="%.4f")
    return [
        head.replace("FORMAT", "binary_little_endian").encode() + rows.tobytes(),
        head.replace("FORMAT", "ascii").encode() + text.getvalue().encode(),
    ]


def _read(name: str, data: bytes, folder: Path) -> None:
    path = _put(folder, name, data)
    scan = read_export(_PROFILE, ScanExport(path.name, (path,), "2026-11-24T10:00:00Z"))
    if not (np.isfinite(scan.mesh.vertices_m).all() and len(scan.mesh.faces)):
        raise MisbehavedError("a surface that is not finite, or empty, is accepted")


# --- E57 ----------------------------------------------------------------------------------------------------------


@functools.cache
def _crc_table() -> tuple[int, ...]:
    table: list[int] = []
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = value >> 1 ^ (0x82F63B78 if value & 1 else 0)
        table.append(value)
    return tuple(table)


def with_checksums(data: bytes) -> bytes:
    """An E57 file with the checksums (CRC-32C, big-endian) that its pages need, so that mutations get further."""
    table, pages = _crc_table(), bytearray(data)
    for at in range(0, len(pages) - _PAGE + 1, _PAGE):
        crc = 0xFFFFFFFF
        for byte in pages[at : at + _PAGE - 4]:
            crc = crc >> 8 ^ table[(crc ^ byte) & 0xFF]
        pages[at + _PAGE - 4 : at + _PAGE] = struct.pack(">I", crc ^ 0xFFFFFFFF)
    return bytes(pages)


def _e57s(folder: Path) -> list[bytes]:
    import pye57  # noqa: PLC0415 - loads a native library

    points = _seen_mm() / 1000
    row, column = np.mgrid[:ROWS, :COLUMNS]
    x, y, z = np.nan_to_num(points).reshape(-1, 3).T
    data: dict[str, Any] = {"cartesianX": x, "cartesianY": y, "cartesianZ": z}
    data |= {"rowIndex": row.ravel(), "columnIndex": column.ravel()}
    data["cartesianInvalidState"] = (~np.isfinite(points).all(axis=-1)).ravel().astype(np.int8)
    path = folder / "scan.e57"
    with pye57.E57(str(path), mode="w") as file:
        file.write_scan_raw(data, translation=np.array([0.1, 0.2, 0.3]))
    return [path.read_bytes()]


def _e57(data: bytes, folder: Path) -> None:
    _read("scan.e57", with_checksums(data[: 1 << 16]), folder)


# --- surfaces of any kind -----------------------------------------------------------------------------------------


def _exported(kind: str) -> Callable[[Path], list[bytes]]:
    def seeds(_: Path) -> list[bytes]:
        written = trimesh.creation.icosphere(subdivisions=1, radius=150.0).export(file_type=kind)
        return [written.encode() if isinstance(written, str) else bytes(written)]

    return seeds


def _surface(kind: str) -> Callable[[bytes, Path], None]:
    def parse(data: bytes, folder: Path) -> None:
        found = read_surface_file(_put(folder, f"mesh.{kind}", data))
        if not np.isfinite(found.vertices_m).all():
            raise MisbehavedError("a surface that is not finite is accepted")

    return parse


def _one_gltf() -> bytes:
    """A glTF with its buffers within."""
    parts: Any = trimesh.creation.icosphere(subdivisions=1, radius=150.0).export(file_type="gltf")
    document = json.loads(parts["model.gltf"])
    for buffer in document["buffers"]:
        content = base64.b64encode(parts[buffer["uri"]]).decode()
        buffer["uri"] = f"data:application/octet-stream;base64,{content}"
    return json.dumps(document).encode()


# --- video --------------------------------------------------------------------------------------------------------


def _recordings(folder: Path) -> list[bytes]:
    rng = np.random.default_rng(4)
    frames = [rng.integers(90, 120, (32, 48, 3), dtype=np.uint8) for _ in range(4)]
    jpegs = b"".join(cv2.imencode(".jpg", frame)[1].tobytes() for frame in frames)
    found = [jpegs]
    for name, code in (("film.avi", "MJPG"), ("film.mp4", "mp4v")):
        writer = cv2.VideoWriter(str(folder / name), cv2.VideoWriter.fourcc(*code), 25.0, (48, 32))
        for frame in frames:
            writer.write(frame)
        writer.release()
        found.append((folder / name).read_bytes())
    return found


def _video(data: bytes, folder: Path) -> None:
    out = folder / "out"
    out.mkdir()
    camera = VideoCamera(VideoConfig(port=str(_put(folder, "film", data)), aperture_f=4.0, exposure_s=0.01))
    try:
        canonical(dataclasses.asdict(camera.open()))
        camera.apply(_SET)
        for _ in range(2):
            image = camera.capture(out)
            if not image.files or not 0 < image.width < 1 << 16:
                raise MisbehavedError(f"an image of {image.width} pixels in {len(image.files)} files is accepted")
        camera.preview()
        camera.report()
    finally:
        camera.close()


_SURFACE = "drivers.meshes.surface_file:read_surface_file"
_READING = "drivers.scan_profiles.reading:read_export"
TARGETS: tuple[Target, ...] = (
    Target("view_ply", _READING, functools.partial(_read, "view.ply"), _view_plys, (*BYTES, *TEXT)),
    Target("e57", _READING, _e57, _e57s, (*BYTES, *TEXT), pace=0.5),
    Target("surface_off", _SURFACE, _surface("off"), _exported("off"), TEXT),
    Target("surface_glb", _SURFACE, _surface("glb"), _exported("glb"), (*BYTES, *TEXT)),
    Target("surface_gltf", _SURFACE, _surface("gltf"), lambda _: [_one_gltf()], JSON),
    Target("video", "drivers.video:VideoCamera", _video, _recordings, memory_mib=512, pace=0.3),
)
